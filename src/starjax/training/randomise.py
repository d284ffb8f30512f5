"""Disturbances of `starjax stress` as augmentations of training: domain randomisation of images."""

import functools
import zlib
from collections.abc import Mapping

import jax
import jax.numpy as jnp

from starjax import config, errors
from starjax.evaluation.disturbances import DISTURBANCES, base, parse_levels
from starjax.types import Observation

PROBABILITY = 0.5  # of each disturbance in a sample
_ARGUMENT = "train.randomise"
# Apart from the children of `jax.random.split`, which the policy makes of the same key.
_STREAM = zlib.crc32(b"randomise")


def max_levels(train_config: config.TrainConfig) -> dict[str, float]:
    """Returns the maximum levels of a training's disturbances by name.

    Raises:
      errors.UsageError: a disturbance of something else than images, or no such level.
    """
    levels = parse_levels(_ARGUMENT, train_config.randomise)
    for name, level in levels.items():
        if DISTURBANCES.get(name).on_image is None:
            works = [other for other in DISTURBANCES.built_in if DISTURBANCES.get(other).on_image]
            raise errors.UsageError(_ARGUMENT, f"one of {', '.join(works)}", name)
        base.check_levels(_ARGUMENT, name, [level])
    return levels


def randomise(
    train_config: config.TrainConfig, key: jax.Array, observation: Observation
) -> Observation:
    """Applies the training's disturbances to the images of a batch, drawn anew for each sample.

    Args:
      train_config: names and maximum levels; without any, the observation is returned as it is.
      key: of the step; other draws from it are independent of these.
      observation: of a batch; images are uint8 `[B, O, h, w, 3]`.
    """
    levels = max_levels(train_config)
    if not levels or observation.images is None:
        return observation

    def change(key: jax.Array, images: dict[str, jax.Array]) -> dict[str, jax.Array]:
        key_levels, key_episode = jax.random.split(key)
        return disturb_images(draw_levels(key_levels, levels), key_episode, images)

    keys = jax.random.split(jax.random.fold_in(key, _STREAM), len(observation.gripper))
    return observation._replace(images=jax.vmap(change)(keys, observation.images))


def draw_levels(key: jax.Array, highest: Mapping[str, float]) -> dict[str, jax.Array]:
    """Draws a sample's levels: uniform up to the maximum, or 0 with probability one half."""
    is_on, fraction = jax.random.uniform(key, (2, len(highest)))
    fraction = jnp.where(is_on < PROBABILITY, fraction, 0.0)
    return {name: fraction[i] * level for i, (name, level) in enumerate(highest.items())}


def disturb_images(
    levels: Mapping[str, jax.Array], key: jax.Array, images: dict[str, jax.Array]
) -> dict[str, jax.Array]:
    """Applies disturbances to the images `[O, h, w, 3]` of O successive control steps.

    The draws are those of an episode with this key, whose first control step is the first image:
    all images share those of the lens, and each has its own noise.
    """
    for name, level in levels.items():
        kind: base.Disturbance = DISTURBANCES.get(name)
        change = functools.partial(base.change_image, kind, base.start(name, level, key))
        images = {
            camera: jax.vmap(change)(frames, jnp.arange(len(frames)))
            for camera, frames in images.items()
        }
    return images
