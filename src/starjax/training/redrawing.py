"""Images of displaced cameras or with another look, drawn for several steps at once.

A camera needs as long for a few images as for hundreds, so a program of its own draws those of
several steps, which then follow one another as usual. A chunk is a function of the training's key
and of its number: a resumed training meets the same images.
"""

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax.core import errors
from starjax.core.types import Pose
from starjax.data import windows
from starjax.runtime.precompile import Program
from starjax.sim.state import ImageSource
from starjax.training import batches, devices, randomise
from starjax.training.sharding import Setup

# (ImageSource of one moment) -> camera's name -> image; its cameras follow the source's poses.
Draw = Callable[[ImageSource], Mapping[str, Any]]

# Images that a device draws at once: a GPU draws 2,048 one and a half times as fast as 512.
AT_ONCE = {"cpu": 16, "gpu": 2048}


class Displaced(NamedTuple):
    """Images of a step.

    Attributes:
      images: by camera, `[n, S, O, h, w, 3]` uint8 of each device's first n samples in S steps.
      index: int32 `[]`, of the step among these.
    """

    images: dict[str, jax.Array]
    index: Any


def make(
    setup: Setup, draw: Draw | None, data: tuple[Any, ...], ahead: bool
) -> Callable[[jax.Array, int], Displaced | None]:
    """Makes the function from the key of all steps and a step's number to its images.

    Args:
      setup: of the training.
      draw: images of one moment; needed if a disturbance draws them anew.
      data: dataset, frames and their number, see `batches.on_devices`.
      ahead: compile the program in the background.

    Raises:
      UsageError: there are no sources of images, or no function that draws them.
    """
    if not randomise.redraws(setup.train_config):
        return lambda key, step: None
    if draw is None or data[0].sources is None:
        expected = (
            "neither camera nor look without sources of images and a function that draws them"
        )
        raise errors.UsageError(randomise.ARGUMENT, expected, "one of them")
    mesh, train_config = setup.layout.mesh, setup.train_config
    share = randomise.redrawn_count(train_config.batch_size // mesh.size)
    at_once = AT_ONCE.get(mesh.devices.flat[0].platform, AT_ONCE["gpu"])
    count = max(1, at_once // (share * setup.policy_config.obs_horizon))
    body = functools.partial(draw_images, setup, draw, count)
    program = Program(body, out_shardings=devices.batch_sharding(mesh))
    if ahead:
        carry = setup.layout.shapes()
        program.prepare(carry.state.key, carry.state.step, *data)
    drawn: dict[int, dict[str, jax.Array]] = {}

    def of(key: jax.Array, step: int) -> Displaced:
        first = step - step % count  # chunks are aligned to the step's number, wherever it began
        if first not in drawn:
            drawn.clear()
            drawn[first] = program(key, devices.replicate(np.int32(first), mesh), *data)
        return Displaced(drawn[first], np.int32(step - first))

    return of


def draw_images(
    setup: Setup,
    draw: Draw,
    count: int,
    key: jax.Array,
    first: jax.Array,
    dataset: windows.Dataset,
    frames: jax.Array,
    available: jax.Array,
) -> dict[str, jax.Array]:
    """Draws `Displaced.images` of the steps `first`, .. `first + count - 1`."""
    names = list(randomise.max_levels(setup.train_config))

    def chosen(step: jax.Array) -> batches.Choice:
        return batches.choose(setup, key, step, dataset, frames, available)

    # The very draws of these steps' batches: the same keys, chosen twice.
    choice = jax.vmap(chosen, out_axes=1)(first + jnp.arange(count))  # [B, S]
    episode = dataset.episode[choice.frame]
    start = dataset.start[episode][..., None]
    source = dataset.sources.at(start + choice.seen, episode)

    def draw_share(draws: randomise.Draws, source: ImageSource) -> dict[str, jax.Array]:
        samples = randomise.redrawn_count(len(draws.key))
        draws, source = jax.tree.map(lambda x: x[:samples], (draws, source))
        displace = functools.partial(randomise.displace, names)
        cameras: Pose = jax.vmap(jax.vmap(displace))(draws, source.cameras)
        look = jax.vmap(jax.vmap(functools.partial(randomise.has_look, names)))(draws)
        lead = source.qpos.shape[:3]  # counts of samples, steps and the observations of each
        of_sample = source._replace(qpos=None, cameras=cameras, has_look=look)
        of_sample = jax.tree.map(
            lambda x: jnp.broadcast_to(x[:, :, None], (*lead, *x.shape[2:])), of_sample
        )
        flat = jax.tree.map(
            lambda x: x.reshape(-1, *x.shape[3:]), of_sample._replace(qpos=source.qpos)
        )
        images = jax.vmap(lambda one: {name: it.rgb for name, it in draw(one).items()})(flat)
        return jax.tree.map(lambda x: x.reshape(*lead, *x.shape[1:]), images)

    return devices.on_shares(draw_share, setup.layout.mesh)(choice.draws, source)
