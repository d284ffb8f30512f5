"""STAR-Diff by pose: a trocar-agnostic model of (tip pose, gripper), and a network for one turn.

With a wrist the tip's rotation, too, can be the same at every trocar: the model generates it with
the position, and `rcm.through` finds shaft and wrist exactly. The trocar decides the freedom of a
task alone: the turn about the wire that the jaws hold, which is the tip's x axis. A small network
that is given the trocar corrects that turn, arm by arm. It learns to remove a random turn from
demonstrated poses.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.core import config, methods
from starjax.data import normalizer, windows
from starjax.policies import execution, features, generator, hierarchy, path_network
from starjax.policies.base import Params, Policy
from starjax.policies.models import kernels

TURN = 0.3  # rad, standard deviation of the random turns, and the unit of the network's output
MAX_TURN = 3.0  # units, of a correction
HISTORY_NOISE = 0.05  # noise of the measured 6-D rotations, as of the rolls in `hierarchical`


class PreparedPoses(NamedTuple):
    """A batch as the networks learn from it.

    Attributes:
      inputs: observations.
      trocar_condition: `[B, E]` trocar features of the pose model; E = 0 by default.
      model_inputs: prepared inputs of the pose model's loss.
      path: `[B, H, A, 9]` demonstrated positions, normalised, and turned 6-D rotations.
      trocar: `[B, A, 7]` features.
      history: `[B, O, A, 6]` measured 6-D rotations with noise.
      turn: `[B, A]` that the path was turned back by, in units.
    """

    inputs: features.Inputs
    trocar_condition: jax.Array
    model_inputs: Any
    path: jax.Array
    trocar: jax.Array
    history: jax.Array
    turn: jax.Array


def turned(rot6d: jax.Array, angle: jax.Array) -> jax.Array:
    """Turns 6-D rotations `[..., 6]` about their own x axis by `angle` `[...]` rad."""
    R = rcm.rot6d_decode(rot6d)
    cos, sin = jnp.cos(angle)[..., None], jnp.sin(angle)[..., None]
    y, z = R[..., :, 1], R[..., :, 2]
    return rcm.rot6d_encode(jnp.stack([R[..., :, 0], cos * y + sin * z, cos * z - sin * y], -1))


def make(
    method: methods.Method,
    policy_config: config.PolicyConfig,
    sensors: features.Sensors,
    train_config: config.TrainConfig,
) -> Policy:
    """Builds the hierarchical policy in the action space of (position, rotation)."""
    wrist = normalizer.wrist_of(method, sensors.task)
    space = rcm.action_space(method.action_space, wrist)
    arms, rotation = sensors.task.arms, space.slices["R"]
    dim = arms * (space.dim + 1)
    networks = generator.make(method, policy_config, sensors, dim)
    model = networks.model
    observed = generator.sizes(policy_config, sensors, dim).observed
    turns = path_network.make(policy_config, arms, observed, path=space.dim, history=6)

    def init(key: jax.Array) -> Params:
        key_model, key_turn = jax.random.split(key)
        return {**networks.init(key_model), "turn": turns.init(key_turn)}

    def prepare(
        stats: normalizer.Normalizer, key: jax.Array, batch: windows.Batch
    ) -> PreparedPoses:
        key_inputs, key_model, key_turn, key_history = jax.random.split(key, 4)
        action = features.encode_commands(stats, method.action_space, batch, wrist)
        measured = _measured(stats, batch.observation, batch.trocar)
        inputs = features.training_inputs(
            policy_config, train_config, sensors, stats, key_inputs, batch.observation, measured
        )
        path = by_arm(action)[..., : space.dim]
        turn = jax.random.normal(key_turn, (len(path), arms))
        back = jnp.broadcast_to(-TURN * turn[:, None], path.shape[:-1])
        history = by_arm(measured)[..., rotation]
        return PreparedPoses(
            inputs=inputs,
            trocar_condition=features.trocar_condition(method, batch.trocar),
            model_inputs=model.prepare(key_model, action),
            path=path.at[..., rotation].set(turned(path[..., rotation], back)),
            trocar=features.trocar_features(batch.trocar.trocar),
            history=history + HISTORY_NOISE * jax.random.normal(key_history, history.shape),
            turn=turn,
        )

    def loss(params: Params, prepared: PreparedPoses) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Returns pose loss + lambda * turn loss, as Eq. 15."""
        condition = networks.observe(params, prepared.inputs, prepared.trocar_condition)
        pose_loss, metrics = model.loss(params["learner"], condition, prepared.model_inputs)
        path = prepared.path, prepared.trocar, prepared.history
        predicted = turns.along(params["turn"], *path, condition)[..., 0]
        turn_loss = jnp.mean((prepared.turn[:, None] - predicted) ** 2)
        total = pose_loss + policy_config.roll_loss_weight * turn_loss
        return total, {"pose_loss": pose_loss, "turn_loss": turn_loss, **metrics}

    def _decoded(params, stats, x0, measured, condition, trocar):
        # 1. poses and grippers come from the model (as Eq. 12)
        path = by_arm(x0)
        # 2. turns about the wire, for this trocar
        about = features.trocar_features(trocar.trocar)
        history = by_arm(measured)[..., rotation]
        turn = turns.along(params["turn"], path[..., : space.dim], about, history, condition)
        turn = TURN * jnp.clip(turn[..., 0], -MAX_TURN, MAX_TURN)
        path = path.at[..., rotation].set(turned(path[..., rotation], turn))
        # 3. shaft and wrist through the trocar, in closed form
        return execution.command(method, stats, path.reshape(x0.shape), trocar, wrist)

    def by_arm(vector: jax.Array) -> jax.Array:
        """Splits `[..., A * n]` by arm into `[..., A, n]`."""
        return vector.reshape(*vector.shape[:-1], arms, -1)

    def _measured(stats, observation, trocar):
        space = method.action_space
        return features.encode_proprioception(stats, space, observation, trocar, wrist)

    def prepare_for_inference(params: Params) -> Params:
        return {**networks.prepare_for_inference(params), "turn": kernels.packed(params["turn"])}

    metrics = ("pose_loss", "turn_loss", *model.metrics)
    acting = hierarchy.make(
        method, policy_config, sensors, networks, _measured, lambda vector: vector, _decoded
    )
    return Policy(
        init,
        prepare,
        loss,
        acting.sample,
        metrics,
        networks.cast_params,
        prepare_for_inference,
        acting.generate,
        acting.execute,
    )
