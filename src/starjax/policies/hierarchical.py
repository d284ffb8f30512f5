"""STAR-Diff: diffusion for (position, gripper), not told the trocar, and a network for the roll.

Of several arms, positions and grippers are diffused together; one roll network serves each arm in
turn, with that arm's path, trocar and measured rolls.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from starjax import config, methods, rcm
from starjax.data import normalizer, windows
from starjax.models import diffusion, roll_net
from starjax.models.kernels import packed_params
from starjax.policies import diffuser, execution, features
from starjax.policies.base import Params, Policy
from starjax.types import Command, Observation

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
      p: `[B, H, A, 3]` demonstrated positions with noise, for the roll network.
      trocar: `[B, A, 7]` features.
      history: `[B, O, A]` measured rolls with noise.
      roll: `[B, H, A]` demonstrated ones.
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
    seen: features.Sensors,
    train_config: config.TrainConfig,
) -> Policy:
    """The hierarchical policy in an action space of (roll, position)."""
    space = rcm.ACTION_SPACES[method.action_space]
    if set(space.slices) != {"roll", "p"}:
        raise ValueError(
            f"method.action_space: expected one of roll and position, got {method.action_space!r}"
        )
    arms, position, roll = seen.task.arms, space.slices["p"], space.slices["roll"].start
    dim = 4 * arms  # of what is diffused, see `diffused`
    model = diffuser.make(
        policy_config,
        dim,
        features.history_dim(policy_config, seen.task, dim),
        features.extra_dim(method, seen.task),
        len(seen.cameras),
    )
    rolls = roll_net.RollNet(
        width=policy_config.roll_width,
        blocks=policy_config.roll_blocks,
        dtype=jnp.dtype(policy_config.dtype),
    )
    history_weight = float(policy_config.roll_history)
    trocar_weight = float(policy_config.roll_trocar)
    predict = packed_params.applied(rolls.apply)

    def init(key: jax.Array) -> Params:
        key_model, key_roll = jax.random.split(key)
        p = jnp.zeros((1, policy_config.horizon, 3))
        trocar = jnp.zeros((1, features.TROCAR_FEATURES))
        history = jnp.zeros((1, policy_config.obs_horizon))
        observed = jnp.zeros((1, diffuser.observed_dim(policy_config, len(seen.cameras))))
        more = observed if policy_config.roll_observation else None
        return {
            "diffuser": model.init(key_model),
            "roll": rolls.init(key_roll, p, trocar, history, more),
        }

    def rolls_along(
        params: Params,
        p: jax.Array,
        trocar: jax.Array,
        history: jax.Array,
        observed: jax.Array,
    ) -> jax.Array:
        """Eq. 13 `[B, H, A]`, but for what an ablation adds or leaves out."""
        batch, horizon = p.shape[:2]
        more = jnp.repeat(observed, arms, axis=0) if policy_config.roll_observation else None
        found = predict(
            params["roll"],
            p.swapaxes(1, 2).reshape(batch * arms, horizon, 3),
            trocar_weight * trocar.reshape(batch * arms, -1),
            history_weight * history.swapaxes(1, 2).reshape(batch * arms, -1),
            more,
        )
        return found.reshape(batch, arms, horizon).swapaxes(1, 2)

    def prepare(stats: normalizer.Normalizer, key: jax.Array, batch: windows.Batch) -> Prepared:
        key_inputs, key_diffusion, key_p, key_roll = jax.random.split(key, 4)
        action = features.demonstrated(stats, method.action_space, batch)
        measured = _measured(stats, batch.observation, batch.trocar)
        inputs = features.for_training(
            policy_config,
            train_config,
            seen,
            stats,
            key_inputs,
            batch.observation,
            diffused(measured),
        )
        wanted = by_arm(action)
        p, history = wanted[..., position], by_arm(measured)[..., roll]
        return Prepared(
            inputs=inputs,
            extra=features.extra(method, batch.trocar),
            noised=model.noised(key_diffusion, diffused(action)),
            p=p + POSITION_NOISE * jax.random.normal(key_p, p.shape),
            trocar=features.trocar_features(batch.trocar.trocar),
            history=history + ROLL_NOISE * jax.random.normal(key_roll, history.shape),
            roll=wanted[..., roll],
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
        told: rcm.TrocarFrame,
    ) -> Command:
        measured = _measured(stats, observation, told)
        inputs = features.for_sampling(policy_config, seen, stats, observation, diffused(measured))
        extra = features.extra(method, told)
        observed = model.observe(params["diffuser"], inputs)
        reach = stats.action.reach
        reach = None if reach is None else diffused(reach)
        x0 = model.sample(params["diffuser"], keys, observed, extra, reach)
        p, gripper = jnp.split(by_arm(x0), [3], axis=-1)
        about = features.trocar_features(told.trocar)
        gamma = rolls_along(params, p, about, by_arm(measured)[..., roll], observed)
        # within the demonstrated range, as the diffused part is
        gamma = jnp.clip(gamma, -1.0, 1.0)[..., None]
        parts = {"roll": gamma, "p": p}
        ordered = sorted(parts, key=lambda name: space.slices[name].start)
        action = jnp.concatenate([*(parts[name] for name in ordered), gripper], axis=-1)
        action = action.reshape(*x0.shape[:-1], -1)
        return execution.command(method, stats, action, told)

    def by_arm(vector: jax.Array) -> jax.Array:
        """`[..., A * n]` as `[..., A, n]`."""
        return vector.reshape(*vector.shape[:-1], arms, -1)

    def diffused(vector: jax.Array) -> jax.Array:
        """Each arm's position and gripper `[..., A * 4]` of actions `[..., A * (dim + 1)]`."""
        parts = by_arm(vector)
        kept = jnp.concatenate([parts[..., position], parts[..., -1:]], axis=-1)
        return kept.reshape(*vector.shape[:-1], -1)

    def _measured(stats, observation, told):
        return features.measured(stats, method.action_space, observation, told)

    return Policy(init, prepare, loss, sample, ("position_loss", "roll_loss"))
