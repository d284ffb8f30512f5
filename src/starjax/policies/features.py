"""Inputs of the networks: trocar features, and observations with and without augmentation."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.core import config, methods
from starjax.core.types import Observation
from starjax.data import augment, normalizer, windows
from starjax.sim import names
from starjax.sim.task import Task

TROCAR_FEATURES = 7  # for each arm

_LENGTH = 0.05  # m, the largest displacement of a trocar in Eq. 19: features are of order one


class Sensors(NamedTuple):
    """Observations of a policy.

    Attributes:
      task: fields of the state.
      cameras: K names, in the order in which the networks read their images.
    """

    task: Task
    cameras: tuple[str, ...]


class Inputs(NamedTuple):
    """One batch as the condition networks read it.

    Attributes:
      history: `[B, O, S]` normalised low-dimensional measurements.
      images: `[B, O, K, c, c, 3]` cropped and normalised, or None.
      offset: `[B, O, K, 2]` pixels from the centre crop, or None for centre crops.
      features: `[B, O, K * d_v]` of the vision encoder, computed before, instead of `images`.
    """

    history: jax.Array
    images: jax.Array | None = None
    offset: jax.Array | None = None
    features: jax.Array | None = None


def select_sensors(task: Task, cameras: Sequence[str] = ()) -> Sensors:
    """Returns a task's sensors with the given cameras, by default the first one."""
    return Sensors(task, tuple(cameras) or task.cameras[:1])


def per_step(trocar: rcm.TrocarFrame) -> rcm.TrocarFrame:
    """Adds a time axis: frames `[B, A]` become `[B, 1, A]`."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf)[:, None], trocar)


def trocar_features(trocar: rcm.Trocar) -> jax.Array:
    """Encodes trocars `[...]` as `[..., 7]` numbers of order one, continuous in the azimuth."""
    # Eq. 2
    shift = rcm.trocar_position(trocar, jnp.zeros(3))  # from the nominal one
    scalars = jnp.stack(
        [
            trocar.radius / _LENGTH,
            jnp.cos(trocar.polar),
            # phi itself jumps at 2 pi.
            jnp.cos(trocar.azimuth),
            jnp.sin(trocar.azimuth),
        ],
        axis=-1,
    )
    return jnp.concatenate([scalars, shift / _LENGTH], axis=-1)


def trocar_condition_dim(method: methods.Method, task: Task) -> int:
    """Returns the size of `trocar_condition`."""
    return TROCAR_FEATURES * task.arms if method.sees_trocar else 0


def trocar_condition(method: methods.Method, trocar: rcm.TrocarFrame) -> jax.Array:
    """Returns the features of all trocars `[B, E]`; E = 0 if the method ignores the trocar."""
    found = trocar_features(trocar.trocar)
    return found.reshape(len(found), -1) if method.sees_trocar else jnp.zeros((len(found), 0))


def history_dim(policy_config: config.PolicyConfig, task: Task, proprioception: int) -> int:
    """Returns the size of `Inputs.history`; `proprioception` is that of measured poses."""
    if policy_config.observation == "image":
        return proprioception
    state, tips = (
        jax.ShapeDtypeStruct(s, np.float32) for s in ((task.state_size,), (task.arms, 3))
    )
    relative = jax.eval_shape(task.relative, state, tips)
    return proprioception + task.state_size + relative.shape[-1]


def encode_proprioception(
    stats: normalizer.Normalizer,
    action_space: str,
    observation: Observation,
    trocar: rcm.TrocarFrame,
    wrist: rcm.Wrist | None = None,
) -> jax.Array:
    """Encodes measured poses and grippers as normalised actions `[B, O, D]`."""
    pose, gripper, angles = observation.pose, observation.gripper, observation.wrist
    encoded = normalizer.encode(action_space, pose, gripper, per_step(trocar), wrist, angles)
    return stats.action.normalize(encoded)


def encode_commands(
    stats: normalizer.Normalizer,
    action_space: str,
    batch: windows.Batch,
    wrist: rcm.Wrist | None = None,
) -> jax.Array:
    """Encodes the commands of a batch as normalised actions `[B, H, D]`."""
    pose, gripper, angles = batch.command
    encoded = normalizer.encode(action_space, pose, gripper, per_step(batch.trocar), wrist, angles)
    return stats.action.normalize(encoded)


def inference_inputs(
    policy_config: config.PolicyConfig,
    sensors: Sensors,
    stats: normalizer.Normalizer,
    observation: Observation,
    proprioception: jax.Array,
) -> Inputs:
    """Returns the inputs of inference: centre crops, no noise."""
    history = _history(policy_config, sensors.task, stats, observation, proprioception)
    if policy_config.observation == "state":
        return Inputs(history)
    if observation.features is not None:
        return Inputs(history, features=observation.features)
    return Inputs(history, centre_crop(policy_config, _images(sensors, observation)))


def training_inputs(
    policy_config: config.PolicyConfig,
    train_config: config.TrainConfig,
    sensors: Sensors,
    stats: normalizer.Normalizer,
    key: jax.Array,
    observation: Observation,
    proprioception: jax.Array,
) -> Inputs:
    """Returns augmented inputs: noise on low-dimensional entries; crop, jitter, noise on images.

    Features of a frozen encoder, computed on centre crops, are not augmented.
    """
    key_history, key_image = jax.random.split(key)
    history = _history(policy_config, sensors.task, stats, observation, proprioception)
    # Demonstrated states are exact, measured ones are not.
    noise = jax.random.normal(key_history, history.shape, history.dtype)
    history = history + train_config.state_noise * noise
    if policy_config.observation == "state":
        return Inputs(history)
    if policy_config.freeze_encoder:
        return Inputs(history, features=_features(observation))
    images, offset = augment.augment(
        key_image,
        _images(sensors, observation),
        crop=crop_size(policy_config),
        jitter=_of_colours(train_config.jitter, sensors.cameras),
        noise=_of_colours(train_config.image_noise, sensors.cameras),
        dtype=jnp.dtype(policy_config.dtype),
    )
    return Inputs(history, images, offset)


def centre_crop(policy_config: config.PolicyConfig, images: jax.Array) -> jax.Array:
    """Crops images `[..., h, w, 3]` uint8 at the centre for the vision encoder."""
    return augment.center(
        images, crop=crop_size(policy_config), dtype=jnp.dtype(policy_config.dtype)
    )


def crop_size(policy_config: config.PolicyConfig) -> int:
    """Returns the side of the crop in pixels."""
    return round(policy_config.image_size * policy_config.crop_fraction)


def _history(
    policy_config: config.PolicyConfig,
    task: Task,
    stats: normalizer.Normalizer,
    observation: Observation,
    proprioception: jax.Array,
) -> jax.Array:
    if policy_config.observation == "image":
        return proprioception
    if observation.state is None or stats.state is None:
        raise ValueError(
            f"observation.state: expected [..., {task.state_size}] for a policy with "
            'observation="state", got None'
        )
    state = jnp.asarray(observation.state)
    relative = task.relative(state, observation.pose.p)
    return jnp.concatenate([proprioception, stats.state.normalize(state), relative], axis=-1)


def _of_colours(strength: float, cameras: Sequence[str]) -> float | np.ndarray:
    """Returns a strength of augmentation, or `[K]` with none for views of depth."""
    is_depth = np.array([names.is_depth(camera) for camera in cameras])
    return np.where(is_depth, 0.0, strength).astype(np.float32) if is_depth.any() else strength


def _images(sensors: Sensors, observation: Observation) -> jax.Array:
    """Stacks the images of all cameras to `[B, O, K, h, w, 3]`."""
    given = observation.images or {}
    missing = [name for name in sensors.cameras if name not in given]
    if missing:
        raise ValueError(
            f"observation.images: expected {', '.join(sensors.cameras)} for a policy with "
            f'observation="image", got {", ".join(given) or "None"}'
        )
    return jnp.stack([given[name] for name in sensors.cameras], axis=-4)


def _features(observation: Observation) -> jax.Array:
    if observation.features is None:
        raise ValueError(
            "observation.features: expected [..., K * d_v] to train a policy with a frozen "
            "encoder, got None"
        )
    return observation.features
