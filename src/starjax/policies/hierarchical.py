"""STAR-Diff: a trocar-agnostic model of (position, gripper), and a network for the roll.

Positions and grippers of several arms are generated together; one roll network serves every arm,
with that arm's path, trocar and measured rolls. With a wrist it predicts roll, pitch and yaw, the
turns N of an action.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.core import config, methods
from starjax.data import normalizer, windows
from starjax.policies import acting, execution, features, generator, roll_path
from starjax.policies.base import Params, Policy
from starjax.policies.models import kernels

# Noise on the roll network's inputs (standard deviation, normalised units): demonstrated positions
# and rolls are exact, sampled and measured ones are not. It keeps small errors from accumulating,
# and the network from copying the last measured roll.
POSITION_NOISE = 0.02
ROLL_NOISE = 0.05


class Lesson(NamedTuple):
    """Arrays that the roll network learns from.

    Attributes:
      path: `[B, H, A, 3]` demonstrated positions with noise.
      history: `[B, O, A, N]` measured turns with noise.
      target: `[B, H, A, N]` demonstrated turns.
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
      trocar: `[B, A, 7]` features for the roll network.
      lesson: of the roll network.
    """

    inputs: features.Inputs
    trocar_condition: jax.Array
    model_inputs: Any
    trocar: jax.Array
    lesson: Lesson


def make(
    method: methods.Method,
    policy_config: config.PolicyConfig,
    sensors: features.Sensors,
    train_config: config.TrainConfig,
) -> Policy:
    """Builds the hierarchical policy in an action space of (turns, position)."""
    wrist = normalizer.wrist_of(method, sensors.task)
    space = rcm.action_space(method.action_space, wrist)
    if not space.turns or tuple(space.slices) != (*space.turns, "p"):
        raise ValueError(
            f"method.action_space: expected one of turns and position, got {method.action_space!r}"
        )
    arms, position, turns = sensors.task.arms, space.slices["p"], slice(space.slices["p"].start)
    outputs = turns.stop  # N: the position is the last part
    dim = 4 * arms  # size of what is generated, see `extract`
    networks = generator.make(method, policy_config, sensors, dim)
    model = networks.model
    observed = generator.sizes(policy_config, sensors, dim).observed
    init_roll, along = roll_path.make(policy_config, arms, observed, outputs)

    def init(key: jax.Array) -> Params:
        key_model, key_roll = jax.random.split(key)
        return {**networks.init(key_model), "roll": init_roll(key_roll)}

    def extract(vector: jax.Array) -> jax.Array:
        """Extracts positions and grippers `[..., A * 4]` from actions `[..., A * (dim + 1)]`."""
        parts = by_arm(vector)
        kept = jnp.concatenate([parts[..., position], parts[..., -1:]], axis=-1)
        return kept.reshape(*vector.shape[:-1], -1)

    def by_arm(vector: jax.Array) -> jax.Array:
        """Splits `[..., A * n]` by arm into `[..., A, n]`."""
        return vector.reshape(*vector.shape[:-1], arms, -1)

    def prepare(stats: normalizer.Normalizer, key: jax.Array, batch: windows.Batch) -> Prepared:
        key_inputs, key_model, key_p, key_roll = jax.random.split(key, 4)
        seen = batch.observation
        action = features.encode_commands(stats, method.action_space, batch, wrist)
        measured = features.encode_proprioception(
            stats, method.action_space, seen, batch.trocar, wrist
        )
        inputs = features.training_inputs(
            policy_config, train_config, sensors, stats, key_inputs, seen, extract(measured)
        )
        # [B, H, A, 3], [B, O, A, N]
        p, history = by_arm(action)[..., position], by_arm(measured)[..., turns]
        return Prepared(
            inputs=inputs,
            trocar_condition=features.trocar_condition(method, batch.trocar),
            model_inputs=model.prepare(key_model, extract(action)),
            trocar=features.trocar_features(batch.trocar.trocar),
            lesson=Lesson(
                path=p + POSITION_NOISE * jax.random.normal(key_p, p.shape),
                history=history + ROLL_NOISE * jax.random.normal(key_roll, history.shape),
                target=by_arm(action)[..., turns],
            ),
        )

    def loss(params: Params, prepared: Prepared) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Returns the model's loss + lambda * the roll network's (Eq. 15)."""
        condition = networks.observe(params, prepared.inputs, prepared.trocar_condition)
        position_loss, metrics = model.loss(params["learner"], condition, prepared.model_inputs)
        path, history, target = prepared.lesson
        roll = along(params["roll"], path, prepared.trocar, history, condition)
        # The roll network reads demonstrated paths: none of its gradient reaches the model, which
        # therefore cannot learn the trocar.
        roll_loss = jnp.mean((target - roll) ** 2)  # Eq. 14
        # L = L_abs + lambda L_rel
        total = position_loss + policy_config.roll_loss_weight * roll_loss
        return total, {"position_loss": position_loss, "roll_loss": roll_loss, **metrics}

    def decode(params, stats, x0, measured, condition, trocar):
        # 1. positions and grippers come from the model (Eq. 12)
        p, gripper = jnp.split(by_arm(x0), [3], axis=-1)
        # 2. turns along the sampled path (Eq. 13), clipped to the demonstrated range
        about = features.trocar_features(trocar.trocar)
        gamma = along(params["roll"], p, about, by_arm(measured)[..., turns], condition)
        gamma = jnp.clip(gamma, -1.0, 1.0)  # an MLP extrapolates
        # 3. action vector in the order of the space, decoded on the RCM manifold (Alg. 1)
        action = jnp.concatenate([gamma, p, gripper], axis=-1)
        action = action.reshape(*x0.shape[:-1], -1)
        return execution.command(method, stats, action, trocar, wrist)

    def prepare_for_inference(params: Params) -> Params:
        packed = kernels.packed(params["roll"])
        return {**networks.prepare_for_inference(params), "roll": packed}

    sample, generate, execute = acting.make(
        method, policy_config, sensors, networks, wrist, decode, extract
    )
    metrics = ("position_loss", "roll_loss", *model.metrics)
    return Policy(
        *(init, prepare, loss, sample, metrics),
        *(networks.cast_params, prepare_for_inference, generate, execute),
    )
