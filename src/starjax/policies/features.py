"""What the networks are fed: trocar features, and observations with and without augmentation."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from starjax import config, methods, rcm
from starjax.data import augment, normalizer, windows
from starjax.sim.types import Observation

TROCAR_FEATURES = 7
TASK_STATE = 12  # numbers that a "state" observation has in the place of pixels
TASK_FEATURES = TASK_STATE + 9  # that the networks are fed of it

_NEAR = 0.03  # m, the distance at which the tool works on the block
_LENGTH = 0.05  # m, the largest port displacement of Eq. 19: features are of order one


class Inputs(NamedTuple):
    """One batch as the condition networks read it.

    Attributes:
      history: `[B, O, S]` normalised low-dimensional measurements.
      image: `[B, O, c, c, 3]` cropped and normalised frames, or None.
      offset: `[B, O, 2]` pixels from the centre crop, or None for centre crops.
      features: `[B, O, d_v]` of the vision encoder, computed before, in the place of `image`.
    """

    history: jax.Array
    image: jax.Array | None = None
    offset: jax.Array | None = None
    features: jax.Array | None = None


def trocar_features(trocar: rcm.Trocar, p_world_ref: jax.Array) -> jax.Array:
    """A trocar `[...]` as `[..., 7]` numbers of order one, continuous in the azimuth."""
    shift = rcm.trocar_position(trocar, p_world_ref) - jnp.asarray(p_world_ref)
    scalars = jnp.stack(
        [
            trocar.radius / _LENGTH,
            jnp.cos(trocar.polar),
            jnp.cos(trocar.azimuth),
            jnp.sin(trocar.azimuth),
        ],
        axis=-1,
    )
    return jnp.concatenate([scalars, shift / _LENGTH], axis=-1)


def extra_dim(method: methods.Method) -> int:
    """Width of `extra`."""
    return TROCAR_FEATURES if method.sees_trocar else 0


def extra(method: methods.Method, trocar: rcm.Trocar, p_world_ref: jax.Array) -> jax.Array:
    """What conditions the diffusion model beside the observation: the trocar's features or none."""
    return trocar_features(trocar, p_world_ref)[..., : extra_dim(method)]


def measured(
    stats: normalizer.Normalizer,
    action_space: str,
    observation: Observation,
    trocar: rcm.Trocar,
    p_world_ref: jax.Array,
) -> jax.Array:
    """Proprioception `[B, O, A + 1]`: measured pose and gripper as a normalised action."""
    per_frame = jax.tree.map(lambda leaf: jnp.asarray(leaf)[:, None], trocar)
    encoded = normalizer.encode(
        action_space, observation.pose, observation.gripper, per_frame, p_world_ref
    )
    return stats.action.normalize(encoded)


def demonstrated(
    stats: normalizer.Normalizer, action_space: str, batch: windows.Batch, p_world_ref: jax.Array
) -> jax.Array:
    """Demonstrated commands of a batch as normalised actions `[B, H, A + 1]`."""
    per_step = jax.tree.map(lambda leaf: jnp.asarray(leaf)[:, None], batch.trocar)
    encoded = normalizer.encode(
        action_space, batch.command.pose, batch.command.gripper, per_step, p_world_ref
    )
    return stats.action.normalize(encoded)


def for_sampling(
    policy_config: config.PolicyConfig,
    train_config: config.TrainConfig,
    stats: normalizer.Normalizer,
    observation: Observation,
    proprioception: jax.Array,
) -> Inputs:
    """Inputs as they are at inference: centre crops, no noise."""
    history = _history(policy_config, stats, observation, proprioception)
    if policy_config.observation == "state":
        return Inputs(history)
    if observation.features is not None:
        return Inputs(history, features=observation.features)
    return Inputs(history, centre_crop(policy_config, train_config, _frames(observation)))


def for_training(
    policy_config: config.PolicyConfig,
    train_config: config.TrainConfig,
    stats: normalizer.Normalizer,
    key: jax.Array,
    observation: Observation,
    proprioception: jax.Array,
) -> Inputs:
    """Augmented inputs: noise on every low-dimensional number; crop, jitter, noise on pictures.

    What a frozen encoder saw in centre crops stays as it is, so that inference sees the same.
    """
    key_history, key_image = jax.random.split(key)
    history = _history(policy_config, stats, observation, proprioception)
    noise = jax.random.normal(key_history, history.shape, history.dtype)
    history = history + train_config.state_noise * noise
    if policy_config.observation == "state":
        return Inputs(history)
    if policy_config.freeze_encoder:
        return Inputs(history, features=_features(observation))
    image, offset = augment.augment(
        key_image,
        _frames(observation),
        crop=crop_size(policy_config, train_config),
        jitter=train_config.jitter,
        noise=train_config.image_noise,
        dtype=jnp.dtype(policy_config.dtype),
    )
    return Inputs(history, image, offset)


def centre_crop(
    policy_config: config.PolicyConfig, train_config: config.TrainConfig, frames: jax.Array
) -> jax.Array:
    """Frames `[..., h, w, 3]` uint8 as the vision encoder sees them at inference."""
    return augment.center(
        frames,
        crop=crop_size(policy_config, train_config),
        dtype=jnp.dtype(policy_config.dtype),
    )


def crop_size(policy_config: config.PolicyConfig, train_config: config.TrainConfig) -> int:
    """Side of the crop in pixels."""
    return round(policy_config.image_size * train_config.crop_fraction)


def _history(
    policy_config: config.PolicyConfig,
    stats: normalizer.Normalizer,
    observation: Observation,
    proprioception: jax.Array,
) -> jax.Array:
    if policy_config.observation == "image":
        return proprioception
    if observation.state is None or stats.state is None:
        raise ValueError(
            'observation.state: expected [..., 12] for a policy with observation="state", got None'
        )
    task = jnp.concatenate([stats.state.normalize(observation.state), _relative(observation)], -1)
    return jnp.concatenate([proprioception, task], axis=-1)


def _relative(observation: Observation) -> jax.Array:
    """Tip to block, in the world's frame and in the block's, and tip to target: `[..., 9]`.

    They decide a grasp, and a small network does not get such small differences exactly enough from
    positions in the scale of the workspace.
    """
    state = jnp.asarray(observation.state)
    tip = observation.pose.p
    to_block, to_target = state[..., :3] - tip, state[..., 9:12] - tip
    block = rcm.rot6d_decode(state[..., 3:9])
    turned = jnp.einsum("...ji,...j->...i", block, to_block, precision="highest")
    return jnp.concatenate([to_block, turned, to_target], axis=-1) / _NEAR


def _frames(observation: Observation) -> jax.Array:
    if observation.image is None:
        raise ValueError(
            "observation.image: expected [..., h, w, 3] for a policy with "
            'observation="image", got None'
        )
    return observation.image


def _features(observation: Observation) -> jax.Array:
    if observation.features is None:
        raise ValueError(
            "observation.features: expected [..., d_v] to train a policy with a frozen encoder, "
            "got None"
        )
    return observation.features
