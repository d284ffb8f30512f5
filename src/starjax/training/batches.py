"""Batches of a training, one a step: gathered on the device, or by a thread of the host.

A batch is a function of the key of all steps and of the step's number: a resumed training meets the
batches that it would have met without the interruption.
"""

import functools
import itertools
import queue
import threading
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax.data import windows
from starjax.rcm import arrays
from starjax.runtime import processes
from starjax.training import devices, randomise
from starjax.training import state as states
from starjax.training.sharding import Setup

if TYPE_CHECKING:  # for annotations alone
    from starjax.training.redrawing import Displaced

_AHEAD = 2  # batches that wait for their steps
_CHUNK = 64  # steps whose frames are drawn at once

# (key of all steps, step's number) -> `redrawing.Displaced`, or None without any.
Displace = Callable[[jax.Array, int], Any]


class Choice(NamedTuple):
    """Draws of a batch of B windows.

    Attributes:
      frame: int32 `[B]`, frames of the windows.
      draws: their disturbances, None without any.
      seen: int32 `[B, O]`, control steps that are observed, None without disturbances.
    """

    frame: jax.Array
    draws: randomise.Draws | None = None
    seen: jax.Array | None = None


def on_devices(setup: Setup, dataset: windows.Dataset, frames: np.ndarray) -> tuple[Any, ...]:
    """Returns a dataset, frames to draw from and their number on every device."""
    # One program for datasets of about one size: frames beyond the number are never drawn.
    rows = windows.padded_count(max(len(frames), len(dataset.episode)))
    available = np.pad(frames, (0, rows - len(frames))), np.int32(len(frames))
    return devices.replicate((dataset, *available), setup.layout.mesh, may_alias=None)


def drawing(setup: Setup) -> Callable[..., windows.Batch]:
    """Returns the compiled `drawn_batch`.

    A program of its own: the step's is then the same for any number of frames, and can be compiled
    before these are known.
    """
    split = devices.batch_sharding(setup.layout.mesh)
    return jax.jit(functools.partial(drawn_batch, setup), out_shardings=split)


def resident(
    setup: Setup, data: tuple[Any, ...], key: jax.Array, first: int, displace: Displace
) -> Iterator[windows.Batch]:
    """Yields the batches of steps `first`, `first + 1`, ... of a dataset on the device.

    Args:
      setup: of the training.
      data: from `on_devices`.
      key: `Streams.steps`.
      first: number of the first step.
      displace: images that training draws anew.
    """
    draw = drawing(setup)
    for step in itertools.count(first):
        yield draw(key, np.int32(step), *data, displace(key, step))


def streamed(
    setup: Setup,
    dataset: windows.Dataset,
    frames: np.ndarray,
    key: jax.Array,
    first: int,
    data: tuple[Any, ...] = (),
    displace: Displace = lambda key, step: None,
) -> Iterator[windows.Batch]:
    """Yields the batches of `resident`, gathered from a dataset of the host ahead of the steps.

    Close the iterator (or let it go) to end its thread.

    Args:
      setup: of the training.
      dataset: on the host.
      frames: `[n]` frame numbers to draw from.
      key: `Streams.steps`.
      first: number of the first step.
      data: from `on_devices` of the dataset's `windows.places`; empty without disturbances.
      displace: images that training draws anew.
    """

    disturb = jax.jit(functools.partial(_disturbed, setup))
    stream = gathered(setup, dataset, frames, processes.own(key), first)
    for step, batch in enumerate(stream, first):
        # The thread gathers the observed steps; the device disturbs their images.
        yield disturb(key, np.int32(step), batch, displace(key, step), *data) if data else batch


def gathered(
    setup: Setup, dataset: windows.Dataset, frames: np.ndarray, key: jax.Array, first: int
) -> Iterator[windows.Batch]:
    """Yields undisturbed batches, which a thread gathers; see `streamed`."""
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
            for chunk in itertools.count(first, _CHUNK):
                frame, seen = jax.device_get(chosen(chunk))
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


def choose(
    setup: Setup,
    key: jax.Array,
    step: jax.Array,
    dataset: windows.Dataset,
    frames: jax.Array,
    available: jax.Array,
) -> Choice:
    """Chooses the windows of a step; `key` and `step` are the state's.

    It reads the places of the episodes only, see `windows.places`.
    """
    count, keys = setup.train_config.batch_size, states.step_keys(key, step)
    frame = windows.sample_frames(keys.batch, frames, count, available)  # with replacement
    levels = randomise.max_levels(setup.train_config)
    if not levels:
        return Choice(frame)
    draws = randomise.draw(levels, keys.loss, count, count // setup.layout.mesh.size)
    at = windows.control_steps(dataset, frame)
    seen = randomise.seen_steps(list(levels), draws, at, setup.policy_config.obs_horizon)
    return Choice(frame, draws, seen)


def drawn_batch(
    setup: Setup,
    key: jax.Array,
    step: jax.Array,
    dataset: windows.Dataset,
    frames: jax.Array,
    available: jax.Array,
    displaced: "Displaced | None" = None,
) -> windows.Batch:
    """Returns the batch of a step, split over the devices; `key` and `step` are the state's.

    `displaced` is `redrawing.Displaced` if cameras are.
    """
    policy_config = setup.policy_config
    choice = choose(setup, key, step, dataset, frames, available)
    split = devices.batch_sharding(setup.layout.mesh)
    choice = jax.tree.map(lambda x: jax.lax.with_sharding_constraint(x, split), choice)
    batch = windows.gather(
        dataset, choice.frame, policy_config.obs_horizon, policy_config.horizon, choice.seen
    )
    return disturbed(setup, choice, batch, displaced)


def _disturbed(
    setup: Setup,
    key: jax.Array,
    step: jax.Array,
    batch: windows.Batch,
    displaced: "Displaced | None",
    *data: Any,
) -> windows.Batch:
    return disturbed(setup, choose(setup, key, step, *data), batch, displaced)


def disturbed(
    setup: Setup, choice: Choice, batch: windows.Batch, displaced: "Displaced | None" = None
) -> windows.Batch:
    """Disturbs the images of a gathered batch."""
    if choice.draws is None:
        return batch
    if displaced is not None:
        index = displaced.index  # this step's, of several
        displaced = jax.tree.map(lambda x: x[:, index], displaced.images)
    names = list(randomise.max_levels(setup.train_config))

    def change(draws: Any, seen: Any, observation: Any, displaced: Any) -> Any:
        if displaced is not None:
            images = {
                name: randomise.with_first(image, displaced[name])
                for name, image in observation.images.items()
            }
            observation = observation._replace(images=images)
        return randomise.disturb(names, draws, seen, observation)

    change = devices.on_shares(change, setup.layout.mesh)
    observation = change(choice.draws, choice.seen, batch.observation, displaced)
    return batch.replace(observation=observation)
