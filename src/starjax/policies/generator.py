"""Observation encoders, and a learner's sequence model conditioned on their output.

Images are read one by one, by one encoder for all moments and cameras.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from starjax import config, methods
from starjax.models import encoders, kernels
from starjax.policies import features, learner_contract, sequences
from starjax.policies.base import Params
from starjax.policies.sequences import Condition, SequenceModel, Sizes


class Generator(NamedTuple):
    """Pure functions of parameters `{"vision", "state", "learner"}`.

    Attributes:
      init: `key -> params`, those that training changes: without `vision` where no image is read,
        or its encoder is frozen.
      observe: `(params, inputs, trocar_condition [B, E]) -> Condition`.
      model: of sequences, whose parameters are `params["learner"]`.
      cast_params, prepare_for_inference: as those of `sequences.SequenceModel`, of all of them.
    """

    init: Callable[[jax.Array], Params]
    observe: Callable[[Params, features.Inputs, jax.Array], Condition]
    model: SequenceModel
    cast_params: Callable[[Params], Params]
    prepare_for_inference: Callable[[Params], Params]


def sizes(
    policy_config: config.PolicyConfig, sensors: features.Sensors, action: int, trocar: int = 0
) -> Sizes:
    """Returns the sizes for actions of `action` entries and trocar features of size `trocar`."""
    sees_image = policy_config.observation == "image"
    return Sizes(
        horizon=policy_config.horizon,
        action=action,
        obs_horizon=policy_config.obs_horizon,
        vision=len(sensors.cameras) * policy_config.vision_dim if sees_image else 0,
        state=policy_config.state_dim,
        trocar=trocar,
    )


def make(
    method: methods.Method,
    policy_config: config.PolicyConfig,
    sensors: features.Sensors,
    action: int,
) -> Generator:
    """Builds the networks of the settings.

    Args:
      method: its row says if the model is conditioned on the trocar.
      policy_config: networks, and the learner.
      sensors: observed cameras and task.
      action: D, numbers of an action, and of the proprioception of a moment.
    """
    dtype = jnp.dtype(policy_config.dtype)
    vision = vision_encoder(policy_config)
    state = encoders.StateEncoder(features=policy_config.state_dim, dtype=dtype)
    of_state, of_vision = map(kernels.applied, (state, vision))
    size = policy_config.image_size
    dims = sizes(
        policy_config, sensors, action, features.trocar_condition_dim(method, sensors.task)
    )
    model = learner_contract.make(policy_config, dims)
    learns_vision = policy_config.observation == "image" and not policy_config.freeze_encoder
    width = features.history_dim(policy_config, sensors.task, action)

    def init(key: jax.Array) -> Params:
        key_vision, key_state, key_learner = jax.random.split(key, 3)
        history = jnp.zeros((1, policy_config.obs_horizon, width))
        params = {"state": state.init(key_state, history), "learner": model.init(key_learner)}
        if learns_vision:
            params["vision"] = vision.init(key_vision, jnp.zeros((1, size, size, 3)))
        return params

    def observe(params: Params, inputs: features.Inputs, trocar_condition: jax.Array) -> Condition:
        visual = inputs.features
        if visual is None and inputs.images is not None:
            batch, moments, offset = *inputs.images.shape[:2], inputs.offset
            visual = of_vision(
                params["vision"],
                inputs.images.reshape(-1, *inputs.images.shape[3:]),
                None if offset is None else offset.reshape(-1, 2),
            ).reshape(batch, moments, -1)
        return Condition(visual, of_state(params["state"], inputs.history), trocar_condition)

    def cast_params(params: Params) -> Params:
        return {**_cast_vision(params, dtype), "learner": model.cast_params(params["learner"])}

    def prepare_for_inference(params: Params) -> Params:
        # One robot's inference starts later the more arrays are passed: pack them.
        readers = _cast_vision({**params, "learner": {}}, dtype)
        ready = {name: kernels.packed(network) for name, network in readers.items()}
        return {**ready, "learner": model.prepare_for_inference(params["learner"])}

    return Generator(init, observe, model, cast_params, prepare_for_inference)


def vision_encoder(policy_config: config.PolicyConfig) -> encoders.ImageEncoder:
    """Builds the image encoder, whose parameters are `params["vision"]`."""
    return encoders.ImageEncoder(
        trunk=policy_config.encoder,
        features=policy_config.vision_dim,
        dtype=jnp.dtype(policy_config.dtype),
    )


def _cast_vision(params: Params, dtype: jnp.dtype) -> Params:
    """Casts the trunk's kernels; returns other parameters unchanged."""
    if "vision" not in params:
        return params
    inner = params["vision"]["params"]
    trunk = sequences.cast_params(inner["trunk"], {"kernel"}, dtype)
    return {**params, "vision": {"params": {**inner, "trunk": trunk}}}
