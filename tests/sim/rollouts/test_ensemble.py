"""Temporal ensembling, against ACT's formula on plans that are written down."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stubs

from starjax import rcm
from starjax.core import errors
from starjax.core.types import Command, Pose
from starjax.sim.rollouts import engine, ensemble, episodes

HORIZON, STEPS = 4, 7
RNG = np.random.default_rng(0)
# Plan of each control step: positions, roll about the tool's axis, openings.
P = np.float32(RNG.normal((0.0, 0.0, 0.05), 0.01, (STEPS, HORIZON, 3)))
ROLL = np.float32(RNG.normal(0.0, 0.3, (STEPS, HORIZON)))
OPENING = np.float32(RNG.uniform(-1.0, 1.0, (STEPS, HORIZON)))
DOWN = np.float32(np.diag([1.0, -1.0, -1.0]))


def executed(keeps_to_manifold, obs_horizon=2):
    """The commands of an episode, as arrays `[T, ...]` of R, p and opening."""
    base = stubs.make_env(unlucky=0.0)

    def reset(key, params):
        state = base.reset(key, params)
        return state.replace(physics=stubs.Physics(jnp.zeros(13)), gripper=jnp.zeros(1))

    def step(state, command):
        log = jnp.concatenate([command.pose.R.ravel(), command.pose.p[0], command.gripper])
        now = (state.step + 1).astype(jnp.float32)[None]
        return state.replace(physics=stubs.Physics(log), step=state.step + 1, gripper=now)

    def sample(params, stats, keys, observation, told):
        t = observation.gripper[:, -1, 0].astype(jnp.int32)  # the step's number, see `step`
        turn = jax.vmap(jax.vmap(rcm.rotation_z))(jnp.asarray(ROLL)[t])
        pose = Pose((DOWN @ turn)[:, :, None], jnp.asarray(P)[t][:, :, None])
        return Command(pose, jnp.asarray(OPENING)[t][..., None])

    env = base._replace(reset=reset, step=step)
    planner = ensemble.from_policy(sample, obs_horizon, keeps_to_manifold)
    settings = engine.RolloutSettings(0, None, STEPS, 1)
    simulate = engine.make(env, planner, stubs.trocars(11), settings, episodes.SCORE)
    (episode,) = [e for s in simulate((None, None), [(0, 0)]) for e in s.ended]
    log = episode.joined("reached_qpos")
    return log[:, :9].reshape(-1, 3, 3), log[:, 9:12], log[:, 12], env


def averaged(plans, t):
    """ACT's mean for step t of plans `[STEPS, H, ...]`, the i-th oldest weighing exp(-0.01 i)."""
    begun = range(max(0, t - HORIZON + 1), t + 1)
    weights = np.exp(-0.01 * np.arange(len(begun)))
    return np.average([plans[s, t - s] for s in begun], axis=0, weights=weights)


def test_what_is_executed_is_the_weighted_mean_of_all_plans_for_the_moment():
    R, p, opening, _ = executed(keeps_to_manifold=False)
    turns = DOWN @ np.array(jax.vmap(jax.vmap(rcm.rotation_z))(ROLL))
    for t in range(STEPS):
        np.testing.assert_allclose(p[t], averaged(P, t), atol=1e-7)
        np.testing.assert_allclose(opening[t], averaged(OPENING, t), atol=1e-6)
        # Turns about one axis: the mean matrix is that of the mean turn, up to its length.
        x = averaged(turns, t)[:, 0]
        np.testing.assert_allclose(R[t][:, 0], x / np.linalg.norm(x), atol=1e-6)
        np.testing.assert_allclose(R[t].T @ R[t], np.eye(3), atol=1e-6)


def test_of_a_method_on_the_manifold_the_mean_is_there_with_the_same_tip():
    R, p, _, env = executed(keeps_to_manifold=True)
    frame = rcm.trocar_frame(rcm.Trocar(*(x[0, 0] for x in stubs.trocars(11))), env.p_world_ref[0])
    off = rcm.rcm_error(Pose(jnp.asarray(R), jnp.asarray(p)), frame.p_world_trocar)
    assert float(off.max()) < 1e-6
    np.testing.assert_allclose(p, [averaged(P, t) for t in range(STEPS)], atol=1e-7)


def test_a_policy_that_looks_further_back_cannot_plan_at_every_step():
    with pytest.raises(errors.UsageError) as raised:
        executed(False, obs_horizon=3)
    assert raised.value.argument == "obs_horizon"
