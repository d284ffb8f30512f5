"""A hierarchy: a model that generates a part of the actions, and a small network for the rest."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.core import config, methods
from starjax.data import normalizer, windows
from starjax.policies import acting, features, generator
from starjax.policies.base import Policy
from starjax.policies.models import kernels
from starjax.policies.sequences import Params


class Lesson(NamedTuple):
    """Arrays that the small network learns from, of N numbers an arm.

    Attributes:
      path: `[B, H, A, n]` demonstrated path, disturbed.
      history: `[B, O, A, m]` measured values with noise.
      target: `[B, H, A, N]`, or `[B, 1, A, N]` for the same at all times.
    """

    path: jax.Array
    history: jax.Array
    target: jax.Array


class Prepared(NamedTuple):
    """A batch as the networks learn from it.

    Attributes:
      inputs: observations.
      trocar_condition: `[B, E]` trocar features of the model; E = 0 by default.
      model_inputs: prepared inputs of the model's loss.
      trocar: `[B, A, 7]` features for the small network.
      lesson: of the small network.
    """

    inputs: features.Inputs
    trocar_condition: jax.Array
    model_inputs: Any
    trocar: jax.Array
    lesson: Lesson


class SmallNetwork(NamedTuple):
    """The small network's share of a policy.

    Attributes:
      name: of its parameters.
      init: key -> parameters.
      along: (parameters, path `[B, H, A, n]`, trocar features `[B, A, 7]`, history `[B, O, A, m]`,
        Condition) -> `[B, H, A, N]` (Eq. 13, and inputs of ablations).
      lesson: (key, key, actions `[B, H, A * (dim + 1)]`, measured) -> Lesson.
    """

    name: str
    init: Callable[[jax.Array], Any]
    along: Callable[..., jax.Array]
    lesson: Callable[[jax.Array, jax.Array, jax.Array, jax.Array], Lesson]


def by_arm(vector: jax.Array, arms: int) -> jax.Array:
    """Splits `[..., A * n]` by arm into `[..., A, n]`."""
    return vector.reshape(*vector.shape[:-1], arms, -1)


def make(
    method: methods.Method,
    policy_config: config.PolicyConfig,
    sensors: features.Sensors,
    train_config: config.TrainConfig,
    wrist: rcm.Wrist | None,
    networks: generator.Generator,
    generated: str,
    small: SmallNetwork,
    decode: acting.Decode,
    extract: Callable[[jax.Array], jax.Array] = lambda vector: vector,
) -> Policy:
    """Builds the policy.

    Args:
      method, policy_config, sensors, train_config: as of the policy.
      wrist: that the method commands.
      networks: whose model generates sequences.
      generated: name of its part of an action, for the metrics.
      small: the small network.
      decode, extract: see `acting.make`.
    """
    model = networks.model
    losses = f"{generated}_loss", f"{small.name}_loss"

    def init(key: jax.Array) -> Params:
        key_model, key_small = jax.random.split(key)
        return {**networks.init(key_model), small.name: small.init(key_small)}

    def prepare(stats: normalizer.Normalizer, key: jax.Array, batch: windows.Batch) -> Prepared:
        key_inputs, key_model, key_path, key_past = jax.random.split(key, 4)
        space, seen = method.action_space, batch.observation
        action = features.encode_commands(stats, space, batch, wrist)
        measured = features.encode_proprioception(stats, space, seen, batch.trocar, wrist)
        inputs = features.training_inputs(
            policy_config, train_config, sensors, stats, key_inputs, seen, extract(measured)
        )
        return Prepared(
            inputs=inputs,
            trocar_condition=features.trocar_condition(method, batch.trocar),
            model_inputs=model.prepare(key_model, extract(action)),
            trocar=features.trocar_features(batch.trocar.trocar),
            lesson=small.lesson(key_path, key_past, action, measured),
        )

    def loss(params: Params, prepared: Prepared) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Returns the model's loss + lambda * the small network's (Eq. 15)."""
        condition = networks.observe(params, prepared.inputs, prepared.trocar_condition)
        model_loss, metrics = model.loss(params["learner"], condition, prepared.model_inputs)
        path, history, target = prepared.lesson
        said = small.along(params[small.name], path, prepared.trocar, history, condition)
        # The small network reads demonstrated paths: none of its gradient reaches the model, which
        # therefore cannot learn the trocar.
        small_loss = jnp.mean((target - said) ** 2)  # Eq. 14
        # L = L_abs + lambda L_rel
        total = model_loss + policy_config.roll_loss_weight * small_loss
        return total, {**dict(zip(losses, (model_loss, small_loss))), **metrics}

    def prepare_for_inference(params: Params) -> Params:
        packed = kernels.packed(params[small.name])
        return {**networks.prepare_for_inference(params), small.name: packed}

    sample, generate, execute = acting.make(
        method, policy_config, sensors, networks, wrist, decode, extract
    )
    metrics = (*losses, *model.metrics)
    return Policy(
        *(init, prepare, loss, sample, metrics),
        *(networks.cast_params, prepare_for_inference, generate, execute),
    )
