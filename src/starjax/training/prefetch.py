"""Batches of a dataset that is not on the device: gathered by a thread, ahead of the steps."""

import queue
import threading
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from starjax import config
from starjax.data import windows
from starjax.training import devices
from starjax.training import step as steps

_AHEAD = 2
_CHUNK = 64


def batches(
    dataset: windows.Dataset,
    frames: np.ndarray,
    policy_config: config.PolicyConfig,
    train_config: config.TrainConfig,
    mesh: Mesh,
    key: jax.Array,
    first: int,
) -> Iterator[windows.Batch]:
    """Batches of steps `first`, `first + 1`, ..: the ones that `resident_steps` would gather.

    Close the iterator (or let it go) to end its thread.
    """
    on_device = jnp.asarray(frames)
    waiting: queue.Queue = queue.Queue(maxsize=_AHEAD)
    closed = threading.Event()

    @jax.jit
    def chosen(first_step):
        def of(step):
            key_frames, _ = steps.step_keys(key, step)
            return windows.sample_frames(key_frames, on_device, train_config.batch_size)

        return jax.vmap(of)(first_step + jnp.arange(_CHUNK))

    def produce() -> None:
        try:
            step = first
            while not closed.is_set():
                for frame in np.asarray(chosen(step)):
                    if closed.is_set():
                        return
                    batch = windows.gather(
                        dataset, frame, policy_config.obs_horizon, policy_config.horizon
                    )
                    _put(waiting, devices.shard_batch(batch, mesh), closed)
                step += _CHUNK
        except BaseException as error:  # raised where the batch is asked for
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
