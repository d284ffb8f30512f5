"""Batches of a dataset of the host, gathered by a thread ahead of the steps."""

import queue
import threading
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from starjax.data import windows
from starjax.rcm import arrays
from starjax.training import devices
from starjax.training.step import Setup, choose

_AHEAD = 2  # batches that wait for their steps
_CHUNK = 64  # steps whose frames are drawn at once


def batches(
    setup: Setup, dataset: windows.Dataset, frames: np.ndarray, key: jax.Array, first: int
) -> Iterator[windows.Batch]:
    """Yields the batches of steps `first`, `first + 1`, .. that `step.resident_step` would gather.

    Their images are undisturbed.

    Close the iterator (or let it go) to end its thread.

    Args:
      setup: of the training.
      dataset: on the host.
      frames: `[n]` frame numbers to draw from.
      key: `Streams.steps`.
      first: number of the first step.
    """
    policy_config, mesh = setup.policy_config, setup.layout.mesh
    on_device = jnp.asarray(frames)
    places = jax.tree.map(jnp.asarray, windows.places(dataset).replace(sources=None))
    waiting: queue.Queue = queue.Queue(maxsize=_AHEAD)
    closed = threading.Event()

    @jax.jit
    def chosen(first_step):
        def of(step):
            choice = choose(setup, key, step, places, on_device, jnp.int32(len(frames)))
            return choice.frame, choice.seen

        return jax.vmap(of)(first_step + jnp.arange(_CHUNK))

    batch_size = setup.train_config.batch_size
    rows = devices.own_rows(mesh, batch_size)  # others are read by other processes

    @arrays.broadcasting
    def produce() -> None:
        try:
            step = first
            while not closed.is_set():
                frame, seen = jax.device_get(chosen(step))
                for i in range(_CHUNK):
                    if closed.is_set():
                        return
                    batch = windows.gather(
                        dataset,
                        frame[i][rows],
                        policy_config.obs_horizon,
                        policy_config.horizon,
                        None if seen is None else seen[i][rows],
                    )
                    _put(waiting, devices.shard_own(batch, mesh, batch_size), closed)
                step += _CHUNK
        except BaseException as error:  # raised by the consumer's next call
            _put(waiting, error, closed)

    thread = threading.Thread(target=produce, daemon=True, name="starjax-feed")
    thread.start()
    try:
        while True:
            item = waiting.get()
            if isinstance(item, BaseException):
                raise item
            yield item
    finally:
        closed.set()
        thread.join()


def _put(waiting: queue.Queue, item: object, closed: threading.Event) -> None:
    while not closed.is_set():
        try:
            return waiting.put(item, timeout=0.1)
        except queue.Full:
            continue
