"""Disturbances of `starjax stress` as augmentations of training: domain randomisation.

A sample of a batch is an episode of its own. Half of the samples are undisturbed; in the others
each disturbance is on with probability one half, at a uniform level.
"""

import functools
import zlib
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from starjax.core import config, errors
from starjax.core.types import Observation, Pose
from starjax.evaluation.disturbances import DISTURBANCES, base, parse_levels

PROBABILITY = 0.5  # probability of each disturbance in a disturbed sample
ARGUMENT = "train.randomise"
# Apart from the children of `jax.random.split`, which the policy makes of the same key.
_STREAM = zlib.crc32(b"randomise")


class Draws(NamedTuple):
    """Disturbances of B samples.

    Attributes:
      level: `[B, N]` of N disturbances, in the order of the settings.
      key: `[B]` of the samples as episodes.
    """

    level: jax.Array
    key: jax.Array


def max_levels(
    train_config: config.TrainConfig, policy_config: config.PolicyConfig | None = None
) -> dict[str, float]:
    """Returns the maximum levels of a training's disturbances by name.

    Args:
      train_config: settings.
      policy_config: settings of the policy, to check that its training meets the disturbances.

    Raises:
      errors.UsageError: a disturbance of physics or trocars, no such level, or a disturbance of
        images for a training that reads none.
    """
    levels = parse_levels(ARGUMENT, train_config.randomise)
    for name, level in levels.items():
        kind = DISTURBANCES.get(name)
        if not _is_possible(kind):
            works = [name for name in DISTURBANCES.built_in if _is_possible(DISTURBANCES.get(name))]
            raise errors.UsageError(ARGUMENT, f"one of {', '.join(works)}", name)
        base.check_levels(ARGUMENT, name, [level])
        if policy_config and kind.image_only:
            _expect_images(policy_config, name)
    return levels


def redraws(train_config: config.TrainConfig) -> bool:
    """Returns True if training draws images anew: of displaced cameras, or with another look."""
    return bool(redrawn_names(train_config))


def redrawn_names(train_config: config.TrainConfig) -> list[str]:
    """Lists the disturbances of a training that draw images anew."""
    return [name for name in max_levels(train_config) if DISTURBANCES.get(name).redraws]


def disturbed_count(samples: int) -> int:
    """Returns how many of a device's samples, the first ones, are disturbed."""
    return -(-samples // 2)


def redrawn_count(samples: int) -> int:
    """Returns how many of a device's samples, the first ones, have images that are drawn anew.

    Half of the disturbed ones: a fixed number of images to draw.
    """
    return -(-samples // 4)


def draw(levels: Mapping[str, float], key: jax.Array, count: int, share: int) -> Draws:
    """Draws the disturbances of a batch.

    Args:
      levels: maximum levels of N disturbances.
      key: of the step; other draws from it are independent of these.
      count: B.
      share: samples of one device.
    """

    def one(key: jax.Array, number: jax.Array) -> Draws:
        key_levels, key_episode = jax.random.split(key)
        return Draws(draw_levels(key_levels, levels, number, share), key_episode)

    keys = jax.random.split(jax.random.fold_in(key, _STREAM), count)
    return jax.vmap(one)(keys, jnp.arange(count) % share)


def draw_levels(
    key: jax.Array, highest: Mapping[str, float], number: jax.Array, share: int
) -> jax.Array:
    """Draws a sample's levels `[N]`: uniform up to the maximum, or 0.

    `number` is the sample's among the `share` of its device.
    """
    is_on, fraction = jax.random.uniform(key, (2, len(highest)))
    redrawn = jnp.array([DISTURBANCES.get(name).redraws for name in highest])
    # Images drawn anew are a fixed number, for one shape; all others are on by chance.
    is_on = jnp.where(redrawn, number < redrawn_count(share), is_on < PROBABILITY)
    is_on &= number < disturbed_count(share)  # the rest of the batch stays as recorded
    return jnp.where(is_on, fraction, 0.0) * jnp.array(list(highest.values()))


def seen_steps(names: Sequence[str], draws: Draws, step: jax.Array, obs_horizon: int) -> jax.Array:
    """Returns the control steps `[B, O]` whose observations are seen at steps `[B]` and before."""
    # [B, O]: t - O + 1 .. t
    window = jnp.maximum(step[:, None] + jnp.arange(1 - obs_horizon, 1), 0)

    def one(draws: Draws, steps: jax.Array) -> jax.Array:
        # As `with_disturbances` wraps them: the last one acts last, so its past comes first.
        for name, start in reversed(list(_started(names, draws))):
            seen_step = DISTURBANCES.get(name).seen_step
            if seen_step is not None:
                steps = jax.vmap(functools.partial(seen_step, start))(steps)
        return steps

    return jax.vmap(one)(draws, window)


def displace(names: Sequence[str], draws: Draws, cameras: Pose) -> Pose:
    """Displaces the cameras `[C]` of one sample."""
    for name, start in _started(names, draws):
        on_camera = DISTURBANCES.get(name).on_camera
        cameras = cameras if on_camera is None else on_camera(start, cameras)
    return cameras


def has_look(names: Sequence[str], draws: Draws) -> jax.Array | None:
    """Returns `ImageSource.has_look` of one sample, None without a disturbance of the look."""
    found = None
    for name, start in _started(names, draws):
        on_look = DISTURBANCES.get(name).on_look
        found = found if on_look is None else on_look(start)
    return found


def disturb(
    names: Sequence[str], draws: Draws, steps: jax.Array, observation: Observation
) -> Observation:
    """Applies disturbances of images to the disturbed samples of a device's share of a batch.

    Args:
      names: of the disturbances.
      draws: of the samples.
      steps: `[B, O]` seen control steps.
      observation: images are uint8 `[B, O, h, w, 3]`.
    """
    if not any(DISTURBANCES.get(name).on_image for name in names) or observation.images is None:
        return observation
    count = disturbed_count(len(steps))
    first = jax.tree.map(lambda x: x[:count], (draws, steps, observation.images))
    changed = jax.vmap(functools.partial(disturb_images, names))(*first)
    images = jax.tree.map(with_first, observation.images, changed)
    return observation._replace(images=images)


def with_first(images: jax.Array, first: jax.Array) -> jax.Array:
    """Returns images `[B, ...]` whose first ones are replaced."""
    return jnp.concatenate([first, images[len(first) :]])


def disturb_images(
    names: Sequence[str], draws: Draws, steps: jax.Array, images: dict[str, jax.Array]
) -> dict[str, jax.Array]:
    """Applies disturbances to one sample's images `[O, h, w, 3]` of control steps `[O]`.

    The draws are those of an episode with the sample's key: all images share those of the lens,
    and each step has its own noise.
    """
    for name, start in _started(names, draws):
        change = functools.partial(base.change_image, DISTURBANCES.get(name), start)
        images = {
            camera: jax.vmap(functools.partial(change, camera=camera))(frames, steps)
            for camera, frames in images.items()
        }
    return images


def _started(names: Sequence[str], draws: Draws) -> list[tuple[str, base.DisturbanceState]]:
    """Returns the states of one sample's disturbances at the start of its episode."""
    return [(name, base.start(name, draws.level[i], draws.key)) for i, name in enumerate(names)]


def _is_possible(kind: base.Disturbance) -> bool:
    return bool(kind.image_only or kind.seen_step)


def _expect_images(policy_config: config.PolicyConfig, name: str) -> None:
    if policy_config.observation != "image":
        expected, got = "policy.observation image", policy_config.observation
        raise errors.UsageError(ARGUMENT, f"{expected} for {name}", got)
    if policy_config.freeze_encoder:
        expected = "a vision encoder that is trained, without policy.freeze_encoder,"
        raise errors.UsageError(ARGUMENT, f"{expected} for {name}", "a frozen one")
