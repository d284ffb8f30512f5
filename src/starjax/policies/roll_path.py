"""The roll network along a path: one for all arms, given each arm's path and trocar."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from starjax.core import config
from starjax.policies import features, sequences
from starjax.policies.models import kernels, roll_net
from starjax.policies.sequences import Params


def make(
    policy_config: config.PolicyConfig,
    arms: int,
    observed: int,
    outputs: int,
) -> tuple[Callable[[jax.Array], Any], Callable[..., jax.Array]]:
    """Builds the network's `init` and `along` (Eq. 13, and inputs of ablations).

    Args:
      policy_config: its width and blocks, and the ablations of its inputs.
      arms: A.
      observed: size of `sequences.observation_vector`.
      outputs: N, turns of an arm.

    Returns:
      key -> parameters, and (parameters, path `[B, H, A, 3]`, trocar features `[B, A, 7]`, history
      `[B, O, A, N]`, Condition) -> `[B, H, A, N]`.
    """
    network = roll_net.RollNet(
        width=policy_config.roll_width,
        blocks=policy_config.roll_blocks,
        outputs=outputs,
        dtype=jnp.dtype(policy_config.dtype),
    )
    history_weight = float(policy_config.roll_history)
    trocar_weight = float(policy_config.roll_trocar)
    predict = kernels.applied(network)

    def init(key: jax.Array) -> Any:
        p = jnp.zeros((1, policy_config.horizon, 3))
        trocar = jnp.zeros((1, features.TROCAR_FEATURES))
        past = jnp.zeros((1, policy_config.obs_horizon * outputs))
        more = jnp.zeros((1, observed)) if policy_config.roll_observation else None
        return network.init(key, p, trocar, past, more)

    def along(
        params: Params,
        path: jax.Array,
        trocar: jax.Array,
        history: jax.Array,
        condition: sequences.Condition,
    ) -> jax.Array:
        batch, horizon = path.shape[:2]
        more = None
        if policy_config.roll_observation:
            more = jnp.repeat(sequences.observation_vector(condition), arms, axis=0)  # [B * A, C]
        turns = predict(
            params,
            # Arms become rows of the batch: one f_phi serves all of them.
            path.swapaxes(1, 2).reshape(batch * arms, horizon, -1),
            trocar_weight * trocar.reshape(batch * arms, -1),  # 0 hides an input, at equal sizes
            history_weight * history.swapaxes(1, 2).reshape(batch * arms, -1),
            more,
        )
        return turns.reshape(batch, arms, horizon, outputs).swapaxes(1, 2)  # [B, H, A, N]

    return init, along
