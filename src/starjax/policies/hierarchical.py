"""STAR-Diff: a trocar-agnostic model of (position, gripper), and a network for the roll.

Positions and grippers of several arms are generated together; one roll network serves every arm,
with that arm's path, trocar and measured rolls. With a wrist it predicts roll, pitch and yaw, the
turns N of an action.
"""

import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.core import config, methods
from starjax.data import normalizer
from starjax.policies import execution, features, generator, hierarchy, path_network
from starjax.policies.base import Policy
from starjax.policies.hierarchy import by_arm

# Noise on the roll network's inputs (standard deviation, normalised units): demonstrated positions
# and rolls are exact, sampled and measured ones are not. It keeps small errors from accumulating,
# and the network from copying the last measured roll.
POSITION_NOISE = 0.02
ROLL_NOISE = 0.05


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
    observed = generator.sizes(policy_config, sensors, dim).observed
    init, along = path_network.make(policy_config, arms, observed, history=outputs, outputs=outputs)

    def lesson(
        key_p: jax.Array, key_roll: jax.Array, action: jax.Array, measured: jax.Array
    ) -> hierarchy.Lesson:
        wanted = by_arm(action, arms)
        # [B, H, A, 3], [B, O, A, N]
        p, history = wanted[..., position], by_arm(measured, arms)[..., turns]
        return hierarchy.Lesson(
            path=p + POSITION_NOISE * jax.random.normal(key_p, p.shape),
            history=history + ROLL_NOISE * jax.random.normal(key_roll, history.shape),
            target=wanted[..., turns],
        )

    def decode(params, stats, x0, measured, condition, trocar):
        # 1. positions and grippers come from the model (Eq. 12)
        p, gripper = jnp.split(by_arm(x0, arms), [3], axis=-1)
        # 2. turns along the sampled path (Eq. 13), clipped to the demonstrated range
        about = features.trocar_features(trocar.trocar)
        history = by_arm(measured, arms)[..., turns]
        gamma = along(params["roll"], p, about, history, condition)
        gamma = jnp.clip(gamma, -1.0, 1.0)  # an MLP extrapolates
        # 3. action vector in the order of the space, decoded on the RCM manifold (Alg. 1)
        action = jnp.concatenate([gamma, p, gripper], axis=-1)
        action = action.reshape(*x0.shape[:-1], -1)
        return execution.command(method, stats, action, trocar, wrist)

    def extract(vector: jax.Array) -> jax.Array:
        """Extracts positions and grippers `[..., A * 4]` from actions `[..., A * (dim + 1)]`."""
        parts = by_arm(vector, arms)
        kept = jnp.concatenate([parts[..., position], parts[..., -1:]], axis=-1)
        return kept.reshape(*vector.shape[:-1], -1)

    return hierarchy.make(
        *(method, policy_config, sensors, train_config, wrist, networks),
        generated="position",
        small=hierarchy.SmallNetwork("roll", init, along, lesson),
        decode=decode,
        extract=extract,
    )
