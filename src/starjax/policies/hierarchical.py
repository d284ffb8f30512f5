"""STAR-Diff: diffusion for (position, gripper), not told the trocar, and a network for the roll."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from starjax import config, methods, rcm
from starjax.data import normalizer, windows
from starjax.models import diffusion, roll_net
from starjax.models.kernels import packed_params
from starjax.policies import diffuser, execution, features
from starjax.policies.base import Params, Policy
from starjax.sim.types import Observation
from starjax.types import Command

# Demonstrated positions and rolls are exact, sampled and measured ones are not: noise on the roll
# network's inputs (standard deviation, normalised units) keeps small errors from feeding on
# themselves, and a history that cannot be trusted keeps it from copying the last roll.
POSITION_NOISE = 0.02
ROLL_NOISE = 0.05


class Prepared(NamedTuple):
    """A batch as the networks learn from it.

    Attributes:
      inputs: of the diffusion model.
      extra: `[B, E]`, what conditions it beside them.
      noised: its sequences.
      p: `[B, H, 3]` demonstrated positions with noise, for the roll network.
      trocar: `[B, 7]` features.
      history: `[B, O]` measured rolls with noise.
      roll: `[B, H]` demonstrated ones.
    """

    inputs: features.Inputs
    extra: jax.Array
    noised: diffusion.Noised
    p: jax.Array
    trocar: jax.Array
    history: jax.Array
    roll: jax.Array


def make(
    method: methods.Method,
    policy_config: config.PolicyConfig,
    p_world_ref: Any,
    train_config: config.TrainConfig,
) -> Policy:
    """The hierarchical policy in an action space of (roll, position); see `policy.make`."""
    space = rcm.ACTION_SPACES[method.action_space]
    if set(space.slices) != {"roll", "p"}:
        raise ValueError(
            f"method.action_space: expected one of roll and position, got {method.action_space!r}"
        )
    roll = space.slices["roll"].start
    # what is diffused: the position and, after the whole space, the gripper
    diffused = jnp.r_[space.slices["p"], space.dim]
    task_dim = features.TASK_FEATURES if policy_config.observation == "state" else 0
    model = diffuser.make(
        policy_config, len(diffused), len(diffused) + task_dim, features.extra_dim(method)
    )
    rolls = roll_net.RollNet(
        width=policy_config.roll_width,
        blocks=policy_config.roll_blocks,
        dtype=jnp.dtype(policy_config.dtype),
    )
    history_weight = float(policy_config.roll_history)
    trocar_weight = float(policy_config.roll_trocar)
    predict = packed_params.applied(rolls)

    def init(key: jax.Array) -> Params:
        key_model, key_roll = jax.random.split(key)
        p = jnp.zeros((1, policy_config.horizon, 3))
        trocar = jnp.zeros((1, features.TROCAR_FEATURES))
        history = jnp.zeros((1, policy_config.obs_horizon))
        width = diffuser.observed_dim(policy_config)
        seen = jnp.zeros((1, width)) if policy_config.roll_observation else None
        return {
            "diffuser": model.init(key_model),
            "roll": rolls.init(key_roll, p, trocar, history, seen),
        }

    def rolls_along(
        params: Params,
        p: jax.Array,
        trocar: jax.Array,
        history: jax.Array,
        observed: jax.Array,
    ) -> jax.Array:
        """Eq. 13, but for what an ablation adds or leaves out."""
        seen = observed if policy_config.roll_observation else None
        return predict(params["roll"], p, trocar_weight * trocar, history_weight * history, seen)

    def prepare(stats: normalizer.Normalizer, key: jax.Array, batch: windows.Batch) -> Prepared:
        key_inputs, key_diffusion, key_p, key_roll = jax.random.split(key, 4)
        action = features.demonstrated(stats, method.action_space, batch, p_world_ref)
        measured = _measured(stats, batch.observation, batch.trocar)
        inputs = features.for_training(
            policy_config,
            train_config,
            stats,
            key_inputs,
            batch.observation,
            measured[..., diffused],
        )
        p, history = action[..., space.slices["p"]], measured[..., roll]
        return Prepared(
            inputs=inputs,
            extra=features.extra(method, batch.trocar, p_world_ref),
            noised=model.noised(key_diffusion, action[..., diffused]),
            p=p + POSITION_NOISE * jax.random.normal(key_p, p.shape),
            trocar=features.trocar_features(batch.trocar, p_world_ref),
            history=history + ROLL_NOISE * jax.random.normal(key_roll, history.shape),
            roll=action[..., roll],
        )

    def loss(params: Params, given: Prepared) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Eq. 15."""
        observed = model.observe(params["diffuser"], given.inputs)
        position_loss = model.loss(params["diffuser"], observed, given.extra, given.noised)
        predicted = rolls_along(params, given.p, given.trocar, given.history, observed)
        roll_loss = jnp.mean((given.roll - predicted) ** 2)  # Eq. 14
        total = position_loss + policy_config.roll_loss_weight * roll_loss
        return total, {"position_loss": position_loss, "roll_loss": roll_loss}

    def sample(
        params: Params,
        stats: normalizer.Normalizer,
        keys: jax.Array,
        observation: Observation,
        trocar: rcm.Trocar,
    ) -> Command:
        measured = _measured(stats, observation, trocar)
        inputs = features.for_sampling(
            policy_config, train_config, stats, observation, measured[..., diffused]
        )
        extra = features.extra(method, trocar, p_world_ref)
        observed = model.observe(params["diffuser"], inputs)
        reach = stats.action.reach
        reach = None if reach is None else reach[:, diffused]
        x0 = model.sample(params["diffuser"], keys, observed, extra, reach)
        p, gripper = x0[..., :3], x0[..., 3:]
        about = features.trocar_features(trocar, p_world_ref)
        gamma = rolls_along(params, p, about, measured[..., roll], observed)
        # within the demonstrated range, as the diffused part is
        gamma = jnp.clip(gamma, -1.0, 1.0)[..., None]
        parts = {"roll": gamma, "p": p}
        ordered = sorted(parts, key=lambda name: space.slices[name].start)
        action = jnp.concatenate([*(parts[name] for name in ordered), gripper], axis=-1)
        return execution.command(method, stats, action, trocar, p_world_ref)

    def _measured(stats, observation, trocar):
        return features.measured(stats, method.action_space, observation, trocar, p_world_ref)

    return Policy(init, prepare, loss, sample, ("position_loss", "roll_loss"))
