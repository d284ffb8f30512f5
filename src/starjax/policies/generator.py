"""Observation encoders, and a learner's sequence model conditioned on their output.

Images are read one by one, by one encoder for all moments and cameras; views of depth may have one
of their own.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from starjax.core import config, errors, methods
from starjax.core.learners import ENCODERS
from starjax.policies import features, learner_contract, sequences
from starjax.policies.base import Params
from starjax.policies.models import encoders, kernels
from starjax.policies.sequences import Condition, SequenceModel, Sizes
from starjax.sim import names

_READERS = ("vision", "depth")  # parameters of image encoders


class Generator(NamedTuple):
    """Pure functions of parameters `{"vision", "depth", "state", "learner"}`.

    Attributes:
      init: `key -> params`, those that training changes: `vision` and `depth` only where images
        are read, by encoders that are not frozen.
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
    readers = _readers(policy_config, sensors)
    state = encoders.StateEncoder(features=policy_config.state_dim, dtype=dtype)
    of_state = kernels.applied(state)
    size = policy_config.image_size
    dims = sizes(
        policy_config, sensors, action, features.trocar_condition_dim(method, sensors.task)
    )
    model = learner_contract.make(policy_config, dims)
    learns_vision = policy_config.observation == "image" and not policy_config.freeze_encoder
    width = features.history_dim(policy_config, sensors.task, action)

    def init(key: jax.Array) -> Params:
        key_vision, key_state, key_learner = jax.random.split(key, 3)
        history = jnp.zeros((1, policy_config.obs_horizon, width))  # [1, O, S]: shapes alone
        params = {"state": state.init(key_state, history), "learner": model.init(key_learner)}
        if learns_vision:
            for name, (network, _) in readers.items():
                params[name] = network.init(key_vision, jnp.zeros((1, size, size, 3)))
        return params

    def read(params: Params, name: str, images: jax.Array, offset: jax.Array | None) -> jax.Array:
        """Returns the features `[B, O, k * d_v]` of an encoder's k cameras."""
        network, cameras = readers[name]
        if len(cameras) < len(sensors.cameras):
            images = images[:, :, cameras]
            offset = None if offset is None else offset[:, :, cameras]
        batch, moments = images.shape[:2]
        return kernels.applied(network)(
            params[name],
            images.reshape(-1, *images.shape[3:]),  # [B * O * K, c, c, 3]: one encoder for all
            None if offset is None else offset.reshape(-1, 2),
        ).reshape(batch, moments, -1)

    def observe(params: Params, inputs: features.Inputs, trocar_condition: jax.Array) -> Condition:
        visual = inputs.features
        if visual is None and inputs.images is not None:
            # Colours and depth may have encoders of their own; features are joined in their
            # order.
            parts = [read(params, name, inputs.images, inputs.offset) for name in readers]
            visual = parts[0] if len(parts) == 1 else jnp.concatenate(parts, axis=-1)
        # c = [v, s] (Eq. 10, 11); the trocar's part is empty in the paper's method.
        return Condition(visual, of_state(params["state"], inputs.history), trocar_condition)

    def cast_params(params: Params) -> Params:
        return {**_cast_vision(params, dtype), "learner": model.cast_params(params["learner"])}

    def prepare_for_inference(params: Params) -> Params:
        # One robot's inference starts later the more arrays are passed: pack them.
        readers = _cast_vision({**params, "learner": {}}, dtype)
        ready = {name: kernels.packed(network) for name, network in readers.items()}
        return {**ready, "learner": model.prepare_for_inference(params["learner"])}

    return Generator(init, observe, model, cast_params, prepare_for_inference)


def vision_encoder(policy_config: config.PolicyConfig, name: str = "") -> Any:
    """Builds an image encoder, by default the one whose parameters are `params["vision"]`."""
    return encoders.make(
        name or policy_config.encoder,
        features=policy_config.vision_dim,
        dtype=jnp.dtype(policy_config.dtype),
    )


def _readers(
    policy_config: config.PolicyConfig, sensors: features.Sensors
) -> dict[str, tuple[Any, list[int]]]:
    """Returns the image encoders by their parameters' name, each with the numbers of its cameras.

    Raises:
      errors.UsageError: an encoder of depth would read colours.
    """
    is_depth = [names.is_depth(camera) for camera in sensors.cameras]
    # Without an encoder of its own a view of depth is read as a grey image.
    split = bool(policy_config.depth_encoder) and any(is_depth)
    cameras = {
        "vision": [i for i, depth in enumerate(is_depth) if not (split and depth)],
        "depth": [i for i, depth in enumerate(is_depth) if split and depth],
    }
    sees_colours = policy_config.observation == "image" and not all(is_depth)
    if sees_colours and ENCODERS.get(policy_config.encoder).reads_depth:
        expected, hint = "an encoder of colours", "--policy.depth-encoder reads views of depth"
        raise errors.UsageError("policy.encoder", expected, policy_config.encoder, hint)
    kinds = {"vision": policy_config.encoder, "depth": policy_config.depth_encoder}
    return {
        name: (vision_encoder(policy_config, kinds[name]), numbers)
        for name, numbers in cameras.items()
        if numbers
    }


def _cast_vision(params: Params, dtype: jnp.dtype) -> Params:
    """Casts the trunks' kernels; returns other parameters unchanged."""
    cast = {}
    for name in filter(params.__contains__, _READERS):
        inner = params[name]["params"]
        trunk = sequences.cast_params(inner["trunk"], {"kernel"}, dtype)
        cast[name] = {"params": {**inner, "trunk": trunk}}
    return {**params, **cast}
