"""STAR-Diff by pose: a trocar-agnostic model of (tip pose, gripper), and a network for one turn.

With a wrist the tip's rotation, too, can be the same at every trocar: the model generates it with
the position, and `rcm.through` finds shaft and wrist exactly. The trocar decides the freedom of a
task alone: the turn about the wire that the jaws hold, which is the tip's x axis. A small network
that is given the trocar corrects that turn, arm by arm. It learns to remove a random turn from
demonstrated poses.
"""

import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.core import config, methods
from starjax.data import normalizer
from starjax.policies import execution, features, generator, hierarchy, path_network
from starjax.policies.base import Policy
from starjax.policies.hierarchy import by_arm

TURN = 0.3  # rad, standard deviation of the random turns, and the unit of the network's output
MAX_TURN = 3.0  # units, of a correction
HISTORY_NOISE = 0.05  # noise of the measured 6-D rotations, as of the rolls in `hierarchical`


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
    observed = generator.sizes(policy_config, sensors, dim).observed
    init, along = path_network.make(policy_config, arms, observed, path=space.dim, history=6)

    def lesson(
        key_turn: jax.Array, key_history: jax.Array, action: jax.Array, measured: jax.Array
    ) -> hierarchy.Lesson:
        path = by_arm(action, arms)[..., : space.dim]
        turn = jax.random.normal(key_turn, (len(path), arms))
        back = jnp.broadcast_to(-TURN * turn[:, None], path.shape[:-1])
        history = by_arm(measured, arms)[..., rotation]
        return hierarchy.Lesson(
            path=path.at[..., rotation].set(turned(path[..., rotation], back)),
            history=history + HISTORY_NOISE * jax.random.normal(key_history, history.shape),
            target=turn[:, None, :, None],
        )

    def decode(params, stats, x0, measured, condition, trocar):
        # 1. poses and grippers come from the model (as Eq. 12)
        path = by_arm(x0, arms)
        # 2. turns about the wire, for this trocar
        about = features.trocar_features(trocar.trocar)
        history = by_arm(measured, arms)[..., rotation]
        turn = along(params["turn"], path[..., : space.dim], about, history, condition)
        turn = TURN * jnp.clip(turn[..., 0], -MAX_TURN, MAX_TURN)
        path = path.at[..., rotation].set(turned(path[..., rotation], turn))
        # 3. shaft and wrist through the trocar, in closed form
        return execution.command(method, stats, path.reshape(x0.shape), trocar, wrist)

    return hierarchy.make(
        *(method, policy_config, sensors, train_config, wrist, networks),
        generated="pose",
        small=hierarchy.SmallNetwork("turn", init, along, lesson),
        decode=decode,
    )
