"""Search for an arm's mount in a workspace: its base, its tool's turn and its home.

The base decides: the same arm reaches every trocar with a margin, or almost none.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from scipy import optimize

from starjax.sim import ik, linear, mounts
from starjax.sim.arms.base import Mount
from starjax.sim.mounts import Bench, Fit, Targets
from starjax.sim.workspaces import Workspace

SINGULAR_WORTH = 4.0  # rad of margin that a metre of singular value is worth
MEAN_WORTH = 0.1  # weight of the mean over the poses, added to the worst
TABLE_WORTH = 5.0  # rad of margin that a metre of link in the table costs
ITERATIONS = 20  # for inverse kinematics from home
# Differential evolution in rounds; after each the worst poses replace easy ones.
ROUNDS, GENERATIONS, CANDIDATES = 3, 20, 64
POSES, REPLACED = 144, 48


def search(
    at: Bench,
    workspace: Workspace,
    seed: int = 0,
    tilts: bool = False,
    on_round: Callable[[Fit], None] = lambda _: None,
) -> tuple[Mount, Fit]:
    """Searches by differential evolution; returns the best mount and its worst figures.

    Args:
      tilts: True if the base may also lean or hang.
      seed: the same one gives the same mount on the same machine.
      on_round: called with the worst figures after each round.
    """
    every = mounts.targets(workspace, at.wrist)
    middle = mounts.middle(workspace, at.wrist)
    low, high = _bounds(at, workspace, tilts)
    free = low < high
    chosen = np.random.default_rng(seed).choice(len(every.p_world_trocar), POSES, replace=False)
    population, best = "sobol", None
    for round_ in range(ROUNDS):
        merit = functools.partial(_merit, at.flange, at.tip, middle, _at(every, chosen))

        def cost(x: np.ndarray, merit: Callable[..., jax.Array] = merit) -> np.ndarray:
            whole = np.tile(low[:, None], x.shape[1])
            whole[free] = x
            with jax.default_matmul_precision("highest"):
                return -np.asarray(merit(jnp.asarray(whole.T, jnp.float32), at.settings))

        evolution = optimize.differential_evolution(
            cost,
            list(zip(low[free], high[free])),
            vectorized=True,
            updating="deferred",
            popsize=max(1, CANDIDATES // int(free.sum())),
            maxiter=GENERATIONS,
            tol=0,
            polish=False,
            mutation=(0.4, 0.9),
            recombination=0.8,
            init=population,
            rng=seed + round_,
        )
        population = evolution.population
        x = low.copy()
        x[free] = evolution.x
        mount = _mount(at, middle, x)
        reached = mounts.fit(at, mount, every)
        worst_fit = mounts.worst(reached)
        on_round(worst_fit)
        if best is None or _score(worst_fit) > _score(best[1]):
            best = mount, worst_fit
        chosen = _harder(reached, chosen)
    assert best
    return best


def _score(worst_fit: Fit) -> float:
    """Returns the search's objective in rad, that of the worst pose."""
    if worst_fit.residual > mounts.REACHED:
        return -float(worst_fit.residual)
    ease = min(worst_fit.margin, SINGULAR_WORTH * worst_fit.singular)
    return float(ease + TABLE_WORTH * min(worst_fit.height, 0.0))


def _harder(reached: Fit, chosen: np.ndarray) -> np.ndarray:
    """Returns the next round's poses: the worst of all replace the easiest of the chosen ones."""
    ease = np.minimum(reached.margin, SINGULAR_WORTH * reached.singular) - reached.residual
    kept = chosen[np.argsort(ease[chosen])][: POSES - REPLACED]
    others = np.setdiff1d(np.argsort(ease)[:POSES], kept, assume_unique=True)
    return np.concatenate([kept, others[np.argsort(ease[others])][:REPLACED]])


@functools.partial(jax.jit, static_argnames="settings")
def _merit(
    flange: ik.Chain,
    tip: ik.Chain,
    middle: Targets,
    poses: Targets,
    candidates: jax.Array,
    settings: mounts.ArmSettings,
) -> jax.Array:
    """Scores candidates `[S, 6 + J]`: `[S]` rad, negative if a pose is not reached."""

    def one(x: jax.Array) -> jax.Array:
        chain = mounts.standing(flange, tip, x[:6])
        home, missed = _home(chain, middle, x[6:], settings)
        residual, margin, height, J = mounts.reach(chain, home, poses, settings, ITERATIONS)
        ease = jnp.minimum(margin, SINGULAR_WORTH * _least_singular(J))
        sunk = jnp.minimum(jnp.min(height) - settings.link_radius, 0.0)
        good = jnp.min(ease) + MEAN_WORTH * jnp.mean(ease) + TABLE_WORTH * sunk
        far = -jnp.minimum(missed, 1.0) - jnp.mean(jnp.minimum(residual, 1.0))
        merit = jnp.where(jnp.max(residual) < 10 * mounts.REACHED, good, far)
        return jnp.where(jnp.isfinite(merit), merit, -jnp.inf)

    return jax.vmap(one)(candidates)


def _home(
    chain: ik.Chain, middle: Targets, guess: jax.Array, settings: mounts.ArmSettings
) -> tuple[jax.Array, jax.Array]:
    """Solves for the configuration at the middle of the workspace from a guess `[J]`."""
    if settings.remote_centre:
        chain = chain.replace(p_base=chain.p_base + middle.p_world_trocar)
    return ik.solve(chain, middle.pose, guess, mounts.ITERATIONS, guess, settings.rest_gain)


def _least_singular(J: jax.Array) -> jax.Array:
    """Returns a smooth lower bound `[P]` of the least singular value of `J` `[P, 6, J]`.

    1 / sqrt(sum of 1 / s_i^2) over all singular values s_i, without LAPACK (see `sim.linear`).
    """
    small = J @ J.mT if J.shape[-1] >= ik.POSE_SIZE else J.mT @ J
    columns = jnp.eye(small.shape[-1])
    inverse = jax.vmap(jax.vmap(linear.solve_positive, (None, 0)), (0, None))(small, columns)
    return 1.0 / jnp.sqrt(jnp.trace(inverse, axis1=-2, axis2=-1))


def _bounds(at: Bench, workspace: Workspace, tilts: bool) -> tuple[np.ndarray, np.ndarray]:
    """Returns the ranges `[6 + J]` of a mount's numbers; equal ends mean a fixed number."""
    limits = np.clip(at.tip.limits, -np.pi, np.pi).astype(np.float64).T
    box = np.array([workspace.base_low, workspace.base_high])
    if at.settings.remote_centre:
        box = np.zeros((2, 3))
    largest = np.array([np.pi, np.pi, np.pi * tilts])  # yaw, turn, tilt
    angles = np.stack([-largest, largest])
    low, high = np.concatenate([box, angles, limits], axis=1)
    return low, high


def _mount(at: Bench, middle: Targets, x: np.ndarray) -> Mount:
    """Returns the record of a candidate `[6 + J]`, rounded as printed."""
    place, guess = jnp.asarray(x[:6], jnp.float32), jnp.asarray(x[6:], jnp.float32)
    home, _ = _home(mounts.standing(at.flange, at.tip, place), middle, guess, at.settings)
    position, (yaw, turn, tilt), home = (
        tuple(round(float(v), 3) + 0.0 for v in part) for part in (x[:3], x[3:6], home)
    )
    return Mount(position, yaw, turn, home, tilt)


def _at(poses: Targets, index: np.ndarray) -> Targets:
    return jax.tree.map(lambda x: x[index], poses)
