"""Environments with an export's columns, and those whose arrays stay on the device."""

import os

import jax
import mistakes
import numpy as np
import pytest
import stubs
from gymnasium.vector import AutoresetMode
from scipy.spatial.transform import Rotation

from starjax import rcm
from starjax.addons.formats import exported
from starjax.addons.playground import on_device
from starjax.envs import batch, forked, settings, vector
from starjax.sim import env as sim_env

LANES = 3


@pytest.fixture(autouse=True)
def simulated(monkeypatch):
    """A point mass: programs compile in a second."""

    def make(*_, observation, **__):
        made = stubs.make_env(observation, unlucky=0.0)
        return made._replace(task=made.task._replace(time_limit_s=2.0))

    monkeypatch.setattr(sim_env, "make", make)
    batch.make.cache_clear()
    yield
    batch.make.cache_clear()


def env(**given):
    return exported.ExportedVectorEnv(LANES, task="reach", **given)


def test_poses_go_where_they_say_and_a_success_rests():
    lanes = env(trocar_in_state=True, trocar="all")
    observed, _ = lanes.reset(seed=3)
    assert observed in lanes.observation_space
    state, trocar = observed["agent_pos"], observed["trocar"]
    assert state.shape == (LANES, 11) and np.array_equal(state[:, 8:], trocar)
    reference = stubs.P_WORLD_REF[0]
    assert (np.linalg.norm(trocar - reference, axis=-1) < 0.06).all()
    actions = state[:, :8].copy()
    actions[:, :3] = observed["environment_state"][:, :3]  # the goals
    ended = np.zeros(LANES, bool)
    for _ in range(60):
        observed, _, terminated, truncated, info = lanes.step(actions)
        ended |= terminated
    assert ended.all() and info["is_success"].all() and not truncated.any()
    before = observed["agent_pos"]
    np.testing.assert_array_equal(lanes.step(state[:, :8])[0]["agent_pos"], before)
    assert lanes.reset(seed=3)[0]["agent_pos"][0] == pytest.approx(state[0])


def test_quaternions_do_not_flip_while_a_tool_turns():
    lanes = env()
    observed, _ = lanes.reset(seed=0)
    before = observed["agent_pos"]
    actions = before.copy()
    for turn in np.linspace(0.0, 3 * np.pi, 40):
        actions[:, 3:7] = Rotation.from_euler("zx", [turn, 0.1]).as_quat()
        observed, *_ = lanes.step(actions)
        assert (np.sum(observed["agent_pos"][:, 3:7] * before[:, 3:7], -1) > 0.5).all()
        before = observed["agent_pos"]


def test_actions_on_the_manifold_pass_the_trocar():
    lanes = env(actions="rcm4", trocar="all")
    observed, _ = lanes.reset(seed=1)
    rows = np.tile(np.float32([0.3, 0.0, 0.0, 0.02, 1.0]), (LANES, 1))
    rows[:, 1:4] = observed["agent_pos"][:, :3]
    observed, *_ = lanes.step(rows)
    R = Rotation.from_quat(observed["agent_pos"][:, 3:7]).as_matrix()
    pose = rcm.Pose(R.astype(np.float32), observed["agent_pos"][:, :3])
    assert np.asarray(rcm.rcm_error(pose, observed["trocar"])).max() < 1e-5
    np.testing.assert_allclose(rcm.roll_of(pose.R), 0.3, atol=1e-5)


def test_images_have_the_exports_names():
    lanes = env(observation="image")
    observed, _ = lanes.reset(seed=0)
    assert observed in lanes.observation_space
    assert observed["pixels"]["camera"].dtype == np.uint8 and "environment_state" not in observed


def test_wrong_actions_are_one_line():
    lanes = env()
    with mistakes.of("actions", "joint"):
        env(actions="joint")
    lanes.reset(seed=0)
    for wrong in (np.zeros((LANES, 7)), np.zeros((LANES, 8)), np.full((LANES, 8), np.nan)):
        with mistakes.of("actions"):
            lanes.step(wrong)


@pytest.mark.parametrize("mode", AutoresetMode)
def test_arrays_on_the_device_are_those_of_the_host(mode, monkeypatch):
    chosen = settings.make(task="reach", max_episode_steps=3)
    made = exported._episodes(chosen, "rcm4")
    monkeypatch.setattr(batch.mdp, "make", lambda _: made)
    ours = on_device.TaskDeviceEnv(2, autoreset_mode=mode, task="reach")
    theirs = vector.TaskVectorEnv(2, autoreset_mode=mode, task="reach")
    (found, _), (wanted, _) = ours.reset(seed=5), theirs.reset(seed=5)
    for t in range(8):
        jax.tree.map(np.testing.assert_array_equal, found, wanted)
        assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(found))
        if t == 2:
            mask = {"reset_mask": np.array([True, False])}
            ours.reset(options=dict(mask)), theirs.reset(options=dict(mask))
        actions = np.random.default_rng(t).normal(size=(2, 5), scale=0.05).astype(np.float32)
        found, *ends, info = ours.step(jax.numpy.asarray(actions))
        wanted, *wanted_ends, wanted_info = theirs.step(actions)
        for one, other in zip(ends, wanted_ends, strict=True):
            np.testing.assert_allclose(one, other, atol=1e-6)
        np.testing.assert_array_equal(info["stage"], wanted_info["stage"])
        for lane in np.flatnonzero(wanted_info.get("_final_obs", [])):
            last = wanted_info["final_obs"][lane]
            assert info["_final_obs"][lane]
            same = jax.tree.map(lambda x, i=lane: np.asarray(x[i]), info["final_obs"])
            jax.tree.map(np.testing.assert_array_equal, same, last)
    with mistakes.of("actions"):
        ours.step(np.zeros((2, 4)))
    with mistakes.of("arrays", "tensorflow"):
        on_device.TaskDeviceEnv(2, arrays="tensorflow")


def test_a_forked_process_says_to_spawn(monkeypatch):
    lanes = env()
    monkeypatch.setattr(forked, "_was_started", True)
    with mistakes.of("vectorization_mode"):
        env()
    with pytest.raises(Exception, match="spawn") as caught:
        lanes.reset(seed=0)
    assert type(caught.value)(caught.value)  # as Gymnasium raises a worker's error anew


def test_a_fork_after_jax_has_started_is_noticed():
    jax.devices()
    pid = os.fork()
    if not pid:
        os._exit(int(forked._was_started))
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 1
    forked.refuse()  # this one was not forked
