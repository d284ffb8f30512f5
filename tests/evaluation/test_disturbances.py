"""One thing is wrong, by as much as the level says, and nothing else."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stubs

from starjax import rcm
from starjax.evaluation import disturbances
from starjax.evaluation.disturbances import DISTURBANCES, disturbed
from starjax.sim.state import EnvParams
from starjax.types import Command, Pose

KEY = jax.random.key(3)
PARAMS = EnvParams(jax.tree.map(lambda x: x[0], stubs.trocars(4, arms=2)))
CAMERAS = Pose(jnp.stack([jnp.eye(3)] * 2), jnp.array([[0.1, 0.2, 0.3], [0.0, -0.1, 0.4]]))


@pytest.fixture
def env():
    made = stubs.make_env("image", unlucky=0.0, arms=2)

    def reset(key, params):
        return made.reset(key, params).replace(cameras=CAMERAS)

    return made._replace(reset=reset)


def held(state):
    return Command(state.pose, state.gripper)


def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b)))


@pytest.mark.parametrize("name", DISTURBANCES)
def test_without_a_level_nothing_is_wrong(env, name):
    kind = DISTURBANCES[name]
    assert disturbed(env, name, 0.0) is env and kind.levels[0] == 0.0
    assert list(kind.levels) == sorted(set(kind.levels))


@pytest.mark.parametrize("name", DISTURBANCES)
def test_episodes_begin_as_without_it_and_are_their_key_s(env, name):
    wrong = disturbed(env, name, DISTURBANCES[name].levels[-1])
    usual, first, again = (e.reset(KEY, PARAMS) for e in (env, wrong, wrong))
    assert same(first, again) and same(first.layout, usual.layout)
    assert same(first.trocar, usual.trocar) and same(first.pose, usual.pose)
    assert same(wrong.observe(first), wrong.observe(again))


@pytest.mark.parametrize("level", [1.0, 10.0])
def test_trocars_are_told_so_far_from_the_truth(env, level):
    states = [disturbed(env, "trocar_told", level).reset(jax.random.key(k), PARAMS) for k in (0, 1)]
    for state in states:
        apart = state.told.p_world_trocar - state.trocar.p_world_trocar
        np.testing.assert_allclose(jnp.linalg.norm(apart, axis=-1), 1e-3 * level, rtol=1e-2)
    assert not same(states[0].told, states[1].told)


def test_trocars_rise_and_fall_with_the_breath_and_nobody_is_told(env):
    wrong = disturbed(env, "breathing", 5.0)
    state = first = wrong.reset(KEY, PARAMS)
    rises = []
    for _ in range(round(env.control_hz / disturbances.BREATH_HZ)):
        state = jax.jit(wrong.step)(state, held(state))
        apart = state.trocar.p_world_trocar - first.trocar.p_world_trocar
        np.testing.assert_allclose(apart[:, :2], 0.0, atol=1e-6)
        rises.append(float(apart[0, 2]))
        np.testing.assert_allclose(state.told.p_world_trocar, first.told.p_world_trocar, atol=1e-6)
    np.testing.assert_allclose([max(rises), rises[-1]], [5e-3, 0.0], atol=1e-5)
    over = state.replace(done=jnp.ones((), bool))
    assert same(wrong.step(over, held(over)), over)


def test_cameras_are_moved_and_turned(env):
    state = disturbed(env, "camera", 4.0).reset(KEY, PARAMS)
    apart = jnp.linalg.norm(state.cameras.p - CAMERAS.p, axis=-1)
    np.testing.assert_allclose(apart, 4e-3, rtol=1e-3)
    cos = (jnp.trace(state.cameras.R, axis1=1, axis2=2) - 1) / 2
    np.testing.assert_allclose(np.rad2deg(np.arccos(cos)), 2.0, rtol=1e-2)


@pytest.mark.parametrize(
    ("name", "level", "wanted"),
    [
        ("darkness", 0.4, lambda x: 0.6 * x),
        ("smoke", 0.25, lambda x: 0.75 * x + 0.25 * 255),
    ],
)
def test_images_are_changed_as_is_said(env, name, level, wanted):
    image = np.random.default_rng(0).integers(0, 256, (6, 6, 3)).astype(np.uint8)
    plain = env._replace(observe=lambda state: _seeing(env, state, image))
    found = disturbed(plain, name, level).observe(env.reset(KEY, PARAMS)).images["camera"]
    np.testing.assert_allclose(found, wanted(image.astype(float)), atol=0.51)


def test_blurred_pixels_are_means_of_those_around_that_there_are(env):
    image = np.random.default_rng(0).integers(0, 256, (6, 6, 3)).astype(np.uint8)
    plain = env._replace(observe=lambda state: _seeing(env, state, image))
    found = disturbed(plain, "blur", 1.0).observe(env.reset(KEY, PARAMS)).images["camera"]
    for at, around in (((1, 1), np.s_[:3, :3]), ((0, 0), np.s_[:2, :2]), ((5, 3), np.s_[4:, 2:5])):
        np.testing.assert_allclose(found[at], image[around].mean((0, 1)), atol=0.51)


def test_noise_is_as_strong_as_said_and_new_at_every_step(env):
    grey = np.full((100, 100, 3), 128, np.uint8)
    noisy = disturbed(env._replace(observe=lambda s: _seeing(env, s, grey)), "noise", 0.05)
    state = env.reset(KEY, PARAMS)
    now, later, other = (
        noisy.observe(s).images["camera"].astype(float)
        for s in (state, state.replace(step=state.step + 1), env.reset(jax.random.key(9), PARAMS))
    )
    np.testing.assert_allclose(now.std() / 255, 0.05, rtol=0.05)
    for image in (later, other):
        assert abs(np.corrcoef(now.ravel(), image.ravel())[0, 1]) < 0.05


def _seeing(env, state, image):
    return env.observe(state)._replace(images={"camera": jnp.asarray(image)})


def test_policies_of_states_see_what_they_saw():
    env = stubs.make_env("state")
    params = EnvParams(rcm.Trocar(*(x[0] for x in stubs.trocars(4))))
    state = env.reset(KEY, params)
    for name, kind in DISTURBANCES.items():
        if kind.of_images and not kind.moves_cameras:
            assert same(disturbed(env, name, kind.levels[-1]).observe(state), env.observe(state))
