"""Playground's shape: a proportional controller, as a scan over a batch, solves reach."""

import abc
import inspect
import pathlib
import sys
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.addons.playground import environment as playground
from starjax.addons.playground import registry as playground_registry
from starjax.core.types import Command
from starjax.envs import settings

LANES, STEPS = 4, 120


@pytest.fixture(scope="module")
def env():
    return playground.make("reach", trocar="unseen", max_episode_steps=STEPS)


def test_it_has_what_playgrounds_learners_read(env):
    assert list(inspect.signature(env.reset).parameters) == ["rng"]
    assert list(inspect.signature(env.step).parameters) == ["state", "action"]
    assert set(playground.State.__dataclass_fields__) == {
        *("data", "obs", "reward", "done", "metrics", "info")
    }
    assert env.action_size == 5 and env.observation_size == 22 and env.unwrapped is env
    assert env.n_substeps * env.sim_dt == pytest.approx(env.dt) == pytest.approx(1 / 30)
    assert env.mj_model.nq == env.mjx_model.nq and env.episode_length == STEPS
    assert len(repr(env)) < 100 and pathlib.Path(env.xml_path).is_file()


def test_a_trajectory_is_rendered_state_by_state():
    episodes = types.SimpleNamespace(camera=lambda shade: jnp.full((4, 6, 3), shade, jnp.uint8))
    env = playground.Environment(*[None] * 10, episodes=episodes)
    states = [playground.State(shade, *[None] * 5) for shade in (3, 200)]
    assert env.render(states[1]).shape == (4, 6, 3)
    assert [image.max() for image in env.render(states)] == [3, 200]


@pytest.mark.slow
@pytest.mark.release
def test_a_proportional_controller_reaches_and_rests(env):
    def towards(state):
        goal = state.data.pose._replace(p=state.data.layout.p[None])
        return jnp.clip(env.episodes.encode(state.data, Command(goal, -jnp.ones(1))), -1.0, 1.0)

    @jax.jit
    def run(keys):
        state = jax.vmap(env.reset)(keys)
        state = state.replace(info={"mine": jnp.arange(LANES)})

        def body(state, _):
            after = jax.vmap(env.step)(state, jax.vmap(towards)(state))
            return after, (after.reward, after.done, after.metrics["rcm_error"])

        return jax.lax.scan(body, state, length=STEPS)

    state, (reward, done, rcm_error) = run(jax.random.split(jax.random.key(0), LANES))
    assert state.metrics["is_success"].all() and (state.done == 1.0).all()
    assert state.data.step.max() < STEPS and float(rcm_error.max()) < 1e-3
    np.testing.assert_array_equal(state.info["mine"], np.arange(LANES))
    live = np.asarray(done) == 0.0
    assert (reward[live] <= 0).all() and (reward[live] >= -1).all()
    assert float(reward[0].mean()) < -0.5 and not reward[-1].any()
    assert reward.dtype == done.dtype == jnp.float32


@pytest.mark.release
def test_a_lane_begun_again_as_playground_does_has_its_first_trocar(env):
    """`wrap_for_brax_training` puts data and observation of the first reset in a finished lane.

    Nothing else may remember the finished episode: a step from there is a step from the reset.
    """
    first = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(1), LANES))
    step = jax.jit(jax.vmap(env.step))
    action = 0.3 * jnp.ones((LANES, env.action_size))
    later = step(step(first, action), action)
    is_done = jnp.arange(LANES) < 2

    def where_done(begun, going):
        return jnp.where(is_done.reshape(-1, *[1] * (begun.ndim - 1)), begun, going)

    begun = later.replace(
        data=jax.tree.map(where_done, first.data, later.data),
        obs=where_done(first.obs, later.obs),
        done=is_done.astype(jnp.float32),
    )
    again, expected = step(begun, action), step(first, action)
    for leaf, other in zip(jax.tree.leaves(again), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(leaf[:2], other[:2])
    trocars = np.asarray(again.data.trocar.p_world_trocar)[:, 0]
    np.testing.assert_array_equal(trocars, np.asarray(first.data.trocar.p_world_trocar)[:, 0])
    assert len(np.unique(trocars, axis=0)) == LANES
    assert np.asarray(again.data.step).tolist() == [1, 1, 3, 3]


def test_tasks_are_in_playgrounds_registry(monkeypatch):
    """A fake of Playground: its registry's signature, and its abstract class."""
    rows, made = {}, []
    fake = types.ModuleType("mujoco_playground")
    fake.MjxEnv = type("MjxEnv", (abc.ABC,), {})
    register = lambda name, cls, config: rows.update({name: (cls, config)})  # noqa: E731
    fake.manipulation = types.SimpleNamespace(register_environment=register)
    collections = types.ModuleType("ml_collections")
    collections.ConfigDict = type("ConfigDict", (dict,), {"to_dict": lambda self: dict(self)})
    monkeypatch.setitem(sys.modules, "mujoco_playground", fake)
    monkeypatch.setitem(sys.modules, "ml_collections", collections)
    names = playground_registry.register()
    assert "StarjaxPegTransferBimanual" in names and list(rows) == names
    assert issubclass(playground.Environment, fake.MjxEnv)
    make, default = rows["StarjaxReach"]
    monkeypatch.setattr(playground, "make", lambda task, **given: made.append((task, given)))
    make(config=default(), config_overrides={"trocar": "unseen"})
    ((task, given),) = made
    assert task == "reach" and given["trocar"] == "unseen"
    assert given["max_episode_steps"] == default()["episode_length"] > 0
    settings.make(task=task, **given)  # every entry is a setting
