"""Steps of a policy gradient with clipped ratios, and demonstrations that hold the policy.

PPO (Schulman et al., arXiv:1707.06347). Given the learner's own noise, a decision is a plan that is
displaced as a whole (`explore`). The mean of its executed commands is normal about that of the plan
that the policy generates; the other commands never act. The shape of a plan is not explored: the
loss on demonstrations holds it.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.typing import ArrayLike

from starjax.addons.finetune import advantages, critic
from starjax.addons.finetune.explore import Experience, ExploreSettings
from starjax.core.types import ArrayTree
from starjax.data import windows
from starjax.policies.base import Params, Policy
from starjax.runtime import precompile

CLIP = 0.2  # bound of the ratio of densities of all executed commands
EPOCHS = 4  # over the decisions of an iteration
VALUE_EPOCHS = 12  # further ones, of the critic alone
BATCH = 4096  # decisions per step
# At which the policy's steps of an iteration end. With 256 episodes a point mass learned in half of
# the iterations that 0.02 took.
MAX_KL = 0.06
# Largest divergence of one step, which is shortened to it: the noise is so small that a step of
# Adam's length alone had 3.5.
STEP_KL = 3e-3
ANCHOR = 0.3  # weight of the loss on demonstrations
ANCHOR_SHARE = 4  # decisions per window of its batch: its noise is then as that of the decisions
_ALL = 2**31 - 1


class Learning(NamedTuple):
    """State of the learning.

    Attributes:
      params: of the policy, without a vision encoder.
      optimizer: their optimiser's state.
      critic: of the values.
    """

    params: Params
    optimizer: Any
    critic: critic.Critic


class Demonstrations(NamedTuple):
    """Windows that hold the policy: a dataset on the device and its frames `[F]`."""

    dataset: windows.Dataset
    frames: Any


def demonstrated(dataset: windows.Dataset, held_out: int) -> Demonstrations:
    """Returns a dataset on the device and its frames without those of held-out demonstrations."""
    frames, _ = windows.split_holdout(dataset.start, dataset.length, dataset.trocar, held_out)
    return Demonstrations(jax.tree.map(jnp.asarray, dataset), jnp.asarray(frames))


def optimizer(rate: float) -> optax.GradientTransformation:
    """Returns Adam that leaves out steps whose gradient is not finite."""
    return optax.apply_if_finite(optax.adam(rate), max_consecutive_errors=_ALL)


def begin(
    adam: optax.GradientTransformation, params: Params, key: jax.Array, experience: Experience
) -> Learning:
    """Returns the state before the first iteration, whose experience scales the critic's inputs."""
    values = critic.begin(key, experience.seen, experience.alive)
    return Learning(params, adam.init(params), values)


def log_density(action: jax.Array, plan: jax.Array, noise: ArrayLike) -> jax.Array:
    """Returns the log of the density of displaced plans `[B, E, D]`, without its constant."""
    moved = jnp.mean(action - plan, axis=-2)
    return -0.5 * jnp.sum((moved / noise) ** 2, axis=-1)


def divergence(plan: jax.Array, other: jax.Array, noise: ArrayLike) -> jax.Array:
    """Returns a bound of the KL divergence of the densities about two plans `[B, E, D]`.

    It is the divergence of single commands, averaged over B and E: that of their mean is smaller,
    and a change of the plan's shape counts too.
    """
    squared = jnp.sum(((plan - other) / noise) ** 2, axis=-1)
    return 0.5 * jnp.mean(squared)


def _share(kl: jax.Array) -> jax.Array:
    """Returns the share of a step of this divergence that has STEP_KL, at most 1: it is square."""
    share = jnp.sqrt(STEP_KL / jnp.maximum(kl, STEP_KL))
    return jnp.where(jnp.isfinite(share), share, 0.0)


def surrogate(log_ratio: jax.Array, advantage: jax.Array) -> jax.Array:
    """Returns the clipped objective `[B]`, Eq. 7, to be maximised."""
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1.0 - CLIP, 1.0 + CLIP)
    return jnp.minimum(ratio * advantage, clipped * advantage)


def make(
    policy: Policy, adam: optax.GradientTransformation, settings: ExploreSettings, horizon: int
) -> precompile.Program:
    """Builds the program of an iteration's steps.

    Args:
      adam: see `optimizer`.
      policy: its `prepare` reads features instead of images.
      settings: of the episodes.
      horizon: of a demonstration's window.

    Returns:
      learn(learning, stats, Experience, noise, Demonstrations, key, trains_policy) -> Learning,
      metrics, where `noise` is the deviation of all episodes, see `explore.make`:
      `kl` and `clipped` of the last step, `steps` of the policy, `explained`, the share of the
      returns' variance that the critic foresaw. `trains_policy` False trains the critic alone.
    """
    generate = policy.generate
    assert generate is not None

    def rows_of(experience: Experience) -> tuple[Any, ...]:
        """Returns the inputs of the density, with one leading axis `[N R]`."""
        count, decisions = experience.alive.shape
        trocar = jax.tree.map(lambda x: jnp.repeat(x, decisions, 0), experience.trocar)
        parts = experience.observation, experience.key, experience.action
        flat = jax.tree.map(lambda x: x.reshape(count * decisions, *x.shape[2:]), parts)
        return (*flat, trocar)

    def mean_of(params: optax.Params, stats: Any, row: tuple[Any, ...]) -> jax.Array:
        observation, keys, action, trocar = row
        return generate(params, stats, keys, observation, trocar)[:, : action.shape[1]]

    def anchor(
        params: Params, stats: Any, demonstrations: Demonstrations, key: jax.Array, count: int
    ):
        key_rows, key_loss = jax.random.split(key)
        frames = jax.random.choice(key_rows, demonstrations.frames, (count,))
        batch = windows.gather(demonstrations.dataset, frames, settings.obs_horizon, horizon)
        return policy.loss(params, policy.prepare(stats, key_loss, batch))[0]

    def learn(learning, stats, experience, noise, demonstrations, key, trains_policy):
        with jax.default_matmul_precision("highest"):  # the density is sharp: the noise is small
            return steps(learning, stats, experience, noise, demonstrations, key, trains_policy)

    def steps(learning, stats, experience, noise, demonstrations, key, trains_policy):
        alive = experience.alive
        value = critic.values(learning.critic, experience.seen)
        estimates = advantages.estimate(experience.reward, value, alive)
        advantage = advantages.standardised(estimates.advantage, alive).reshape(-1)
        returns, seen = estimates.returns.reshape(-1), experience.seen.reshape(alive.size, -1)
        rows = rows_of(experience)
        batch = min(BATCH, alive.size)
        anchored = max(batch // ANCHOR_SHARE, 1)
        whole = jnp.arange(-(-alive.size // batch) * batch).reshape(-1, batch) % alive.size

        def density(index: jax.Array) -> jax.Array:
            row = _taken(rows, index)
            return log_density(row[2], mean_of(learning.params, stats, row), noise)

        old = jax.lax.map(density, whole).reshape(-1)
        (order,) = jnp.nonzero(alive.reshape(-1), size=alive.size, fill_value=0)
        count = jnp.sum(alive)

        def step(i, carry):
            learning, metrics = carry
            key_rows, key_anchor = jax.random.split(jax.random.fold_in(key, i))
            index = order[jax.random.randint(key_rows, (batch,), 0, count)]

            row = _taken(rows, index)

            def loss(params):
                mean = mean_of(params, stats, row)
                log_ratio = log_density(row[2], mean, noise) - old[index]
                gain = jnp.mean(surrogate(log_ratio, advantage[index]))
                held = anchor(params, stats, demonstrations, key_anchor, anchored)
                # In these units the gradient of the density is that of the commands' squared error,
                # which the loss on demonstrations is too.
                return ANCHOR * held - mean.shape[1] * noise**2 * gain, (log_ratio, mean)

            gradient, (log_ratio, mean) = jax.grad(loss, has_aux=True)(learning.params)
            kl = jnp.mean(jnp.expm1(log_ratio) - log_ratio)
            goes_on = trains_policy & (metrics["kl"] <= MAX_KL) & (kl <= MAX_KL)
            change, optimizer = adam.update(gradient, learning.optimizer, learning.params)
            there = mean_of(optax.apply_updates(learning.params, change), stats, row)
            share = _share(divergence(mean, there, noise))
            change = jax.tree.map(lambda leaf: share * leaf, change)
            moved = optax.apply_updates(learning.params, change), optimizer
            kept = learning.params, learning.optimizer
            params, optimizer = jax.tree.map(
                lambda new, old: jnp.where(goes_on, new, old), moved, kept
            )
            values = critic.step(learning.critic, seen[index], returns[index])
            metrics = {
                "kl": jnp.maximum(metrics["kl"], kl),
                "clipped": jnp.mean(jnp.abs(jnp.expm1(log_ratio)) > CLIP),
                "steps": metrics["steps"] + goes_on,
            }
            return Learning(params, optimizer, values), metrics

        def value_step(i, values):
            index = order[
                jax.random.randint(jax.random.fold_in(key, total + i), (batch,), 0, count)
            ]
            return critic.step(values, seen[index], returns[index])

        first = {"kl": jnp.zeros(()), "clipped": jnp.zeros(()), "steps": jnp.zeros((), jnp.int32)}
        total = jnp.maximum(EPOCHS * count // batch, EPOCHS)
        further = VALUE_EPOCHS // EPOCHS * total
        learning, metrics = jax.lax.fori_loop(0, total, step, (learning, first))
        values = jax.lax.fori_loop(0, further, value_step, learning.critic)
        missed = jnp.var(estimates.returns - value, where=alive)
        explained = 1.0 - missed / jnp.maximum(jnp.var(estimates.returns, where=alive), 1e-8)
        return learning._replace(critic=values), {**metrics, "explained": explained}

    return precompile.Program(learn)


def _taken(tree: ArrayTree, index: jax.Array) -> Any:
    return jax.tree.map(lambda leaf: leaf[index], tree)
