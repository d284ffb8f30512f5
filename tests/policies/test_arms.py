"""Several arms and several cameras: each one's part is independent of the others."""

import dataclasses

import fakes
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax import rcm
from starjax.core import config
from starjax.core.methods import METHODS
from starjax.data import normalizer, windows
from starjax.policies import execution, features, generator
from starjax.policies import policy as policies

TRAIN = config.TrainConfig(state_noise=0.0)
FRAMES = np.arange(60)


def jit(fn):
    # these programs run once: compiling them badly is fast
    return jax.jit(fn, compiler_options={"xla_backend_optimization_level": 0})


@pytest.fixture(scope="module")
def dataset():
    return fakes.dataset(seed=0, demos=4, length=20, arms=2)


def of_arm(tree, arm):
    return jax.tree.map(lambda x: x[:, arm : arm + 1], tree)


def of_both(stats):
    """Two arms' statistics of an action as those of each, one after the other."""
    halves = jax.tree.map(lambda x: np.stack(np.split(np.asarray(x), 2, -1)), stats)
    return [jax.tree.map(lambda x: x[0], halves), jax.tree.map(lambda x: x[1], halves)]


@pytest.mark.parametrize("name", ["dp_ee", "stardiff"])
def test_statistics_of_two_arms_are_those_of_each(dataset, name):
    both = normalizer.fit(METHODS[name], fakes.TWO_ARMS, dataset, FRAMES).action
    for arm, found in enumerate(of_both(both)):
        slots = fakes.TWO_ARMS.slots[arm : arm + 1]
        seen = dataset.observation
        alone = dataset.replace(
            observation=seen._replace(pose=of_arm(seen.pose, arm), state=None),
            command=of_arm(dataset.command, arm),
            trocar=of_arm(dataset.trocar, arm),
        )
        wanted = normalizer.fit(METHODS[name], fakes.task(slots=slots), alone, FRAMES).action
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), found, wanted)


@pytest.mark.parametrize("name", ["dp_ee", "dp_rcm1", "dp_rcm2", "dp_rcm3", "stardiff"])
def test_demonstrated_actions_become_each_arms_commands(dataset, name):
    method = METHODS[name]
    stats = normalizer.fit(method, fakes.TWO_ARMS, dataset, FRAMES)
    batch = windows.gather(dataset, jnp.array([3, 25, 70]), 2, 16)
    action = features.encode_commands(stats, method.action_space, batch)
    command = execution.command(method, stats, action, batch.trocar)
    assert command.pose.p.shape == (3, 16, 2, 3)
    np.testing.assert_allclose(command.pose.p, batch.command.pose.p, atol=2e-6)
    np.testing.assert_allclose(command.pose.R, batch.command.pose.R, atol=2e-5)
    np.testing.assert_allclose(command.gripper, batch.command.gripper, atol=1e-6)
    # one arm's broken action is that arm's alone
    width = action.shape[-1] // 2
    command = execution.command(method, stats, action.at[..., width].set(jnp.nan), batch.trocar)
    np.testing.assert_array_equal(command.gripper[..., 1], -1.0)
    np.testing.assert_allclose(command.gripper[..., 0], batch.command.gripper[..., 0], atol=1e-6)


@pytest.mark.parametrize("name", [pytest.param("dp_rcm1", marks=pytest.mark.release), "stardiff"])
def test_every_parameter_learns_and_samples_are_on_each_manifold(dataset, name):
    policy = policies.make(METHODS[name], fakes.TINY, fakes.TWO_ARMS, TRAIN)
    stats = normalizer.fit(METHODS[name], fakes.TWO_ARMS, dataset, FRAMES)
    params = fakes.params(policy)
    batch = windows.gather(dataset, jnp.array([3, 25, 70]), 2, 16)

    def loss(params):
        return policy.loss(params, policy.prepare(stats, jax.random.key(0), batch))[0]

    value, gradient = jit(jax.value_and_grad(loss))(params)
    assert np.isfinite(value)
    for path, g in jax.tree_util.tree_leaves_with_path(gradient):
        assert np.isfinite(g).all() and (np.abs(g).max() > 0 or "roll" in str(path)), path
    keys = jax.random.split(jax.random.key(1), 3)
    command = jit(policy.sample)(params, stats, keys, batch.observation, batch.trocar)
    through = batch.trocar.p_world_trocar[:, None]
    assert np.asarray(rcm.rcm_error(command.pose, through)).max() <= 1e-6


def test_one_roll_network_serves_every_arm(dataset):
    policy = policies.make(METHODS["stardiff"], fakes.TINY, fakes.TWO_ARMS, TRAIN)
    stats = normalizer.fit(METHODS["stardiff"], fakes.TWO_ARMS, dataset, FRAMES)
    params = jax.tree.map(lambda x: x + 0.01, fakes.params(policy))
    batch = windows.gather(dataset, jnp.array([3, 25, 70]), 2, 16)
    given = jit(policy.prepare)(stats, jax.random.key(0), batch)
    lesson = jax.tree.map(lambda x: x[:, :, ::-1], given.lesson)
    swapped = given._replace(trocar=given.trocar[:, ::-1], lesson=lesson)
    other = swapped._replace(lesson=lesson._replace(target=given.lesson.target))
    loss = jit(policy.loss)
    here, there, wrong = (float(loss(params, x)[1]["roll_loss"]) for x in (given, swapped, other))
    assert here == pytest.approx(there, rel=1e-5) and abs(here - wrong) > 1e-4


def test_each_trocar_of_the_arms_is_told(dataset):
    told = dataset.trocar
    found = features.trocar_condition(METHODS["dp_rcm4"], told)
    wanted = [features.trocar_features(of_arm(told.trocar, arm))[:, 0] for arm in (0, 1)]
    np.testing.assert_allclose(found, np.concatenate(wanted, -1), atol=1e-6)
    assert features.trocar_condition(METHODS["stardiff"], told).shape == (4, 0)


@pytest.mark.slow
def test_cameras_share_an_encoder_and_keep_their_order():
    settings = dataclasses.replace(fakes.TINY, observation="image")
    images = {
        name: jax.random.randint(jax.random.key(i), (2, 2, 32, 32, 3), 0, 256, jnp.uint8)
        for i, name in enumerate(("camera", "wrist"))
    }
    batch = windows.gather(fakes.dataset(seed=0, demos=4, length=20), jnp.array([3, 25]), 2, 16)
    observation = batch.observation._replace(images=images)
    history = jnp.zeros((2, 2, 4))
    stats: normalizer.Normalizer = normalizer.Normalizer(normalizer.MinMax(-1.0, 1.0), None)
    one = generator.make(METHODS["stardiff"], settings, features.select_sensors(fakes.TASK), 4)
    params = jit(one.init)(jax.random.key(0))

    def observed(*cameras):
        seen = features.select_sensors(fakes.TASK, cameras)
        inputs = features.inference_inputs(settings, seen, stats, observation, history)
        return np.asarray(one.observe(params, inputs, jnp.zeros((2, 0))).vision)

    pair, camera, wrist = observed("wrist", "camera"), observed("camera"), observed("wrist")
    np.testing.assert_allclose(pair, np.concatenate([wrist, camera], -1), atol=1e-6)
    seen = features.select_sensors(fakes.TASK, ("wrist", "camera"))
    assert pair.shape == (2, 2, generator.sizes(settings, seen, 4).vision)
    with pytest.raises(ValueError, match=r"observation.images: expected camera, side"):
        observed("camera", "side")
