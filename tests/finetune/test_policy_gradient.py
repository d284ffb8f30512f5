"""Policy gradient in closed loop: it learns, and its commands stay on the RCM manifold."""

import dataclasses
import types

import fakes
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stubs

from starjax import config, methods
from starjax.data import normalizer
from starjax.finetune import explore, policy_gradient
from starjax.policies import policy as policies
from starjax.policies.base import Policy
from starjax.policies.learners.bc import BcConfig
from starjax.types import Command, Pose

TROCARS = stubs.trocars(0, 8)
COUNT = 64
ACTION = 0.1  # m, of an action of 1


def make_env():
    env = stubs.make_env(unlucky=0.0)
    task = env.task._replace(
        state=lambda bound, layout, measurements: jnp.tile(layout.goal[0], 4),
        relative=fakes.relative,
    )
    return env._replace(task=task, scene=types.SimpleNamespace(bound=None))


def starts(first):
    index = np.arange(COUNT, dtype=np.int32) % 2
    trocar = type(TROCARS)(*(np.asarray(field)[index] for field in TROCARS))
    return explore.Starts(trocar, index, first + np.arange(COUNT, dtype=np.int32))


def learned(env, policy, params, stats, static, rate, iterations, demonstrations):
    """Returns the parameters after some iterations, and the experiences and metrics of all."""
    adam = policy_gradient.optimizer(rate)
    play = explore.make(env, policy, None, (), static)
    learn = policy_gradient.make(policy, adam, static.obs_horizon, fakes.TINY.horizon)
    key, learning, found = jax.random.key(0), None, []
    for i in range(iterations):
        now = params if learning is None else learning.params
        played = play(now, None, stats, starts(i * COUNT), key, jax.random.fold_in(key, i))
        if learning is None:
            learning = policy_gradient.begin(adam, params, key, played)
        learning, metrics = learn(
            learning, stats, played, demonstrations, jax.random.fold_in(key, i), i > 0
        )
        found.append((played, metrics))
    return learning.params, found


SHORT = 0.9  # of the way to a goal: near ones are reached
STATIC = explore.ExploreSettings(obs_horizon=1, execute=8, decisions=5)


def goes(params, stats, keys, observation, trocar):
    p = observation.state[:, -1, :3] * params["scale"] / ACTION
    return jnp.broadcast_to(p[:, None], (len(p), 8, 3))


def moves(params, stats, actions, observation, trocar):
    p = ACTION * actions[:, :, None]
    return Command(Pose(jnp.broadcast_to(jnp.eye(3), (*p.shape, 3)), p), jnp.ones(p.shape[:-1]))


STOPS_SHORT = Policy(
    init=lambda key: {"scale": jnp.float32(SHORT)},
    prepare=lambda stats, key, batch: (),
    loss=lambda params, prepared: (jnp.zeros(()), {}),
    sample=lambda *_: None,
    generate=goes,
    execute=moves,
)


@pytest.fixture(scope="module")
def demonstrations():
    dataset = fakes.dataset(2)
    frames = jnp.arange(int(np.sum(dataset.length)))
    return policy_gradient.Demonstrations(jax.tree.map(jnp.asarray, dataset), frames)


@pytest.mark.slow
def test_a_policy_that_stops_short_learns_to_arrive(demonstrations):
    params, found = learned(
        make_env(), STOPS_SHORT, STOPS_SHORT.init(None), None, STATIC, 3e-3, 50, demonstrations
    )
    rates = [float(played.success.mean()) for played, _ in found]
    assert params["scale"] > SHORT + 0.02
    assert np.mean(rates[-9:]) > np.mean(rates[:9]) + 0.1, rates
    assert found[0][1]["steps"] == 0 and float(found[0][1]["kl"]) == 0.0  # the critic alone


@pytest.mark.slow
@pytest.mark.parametrize("rate", [1e-3, 10.0])
def test_no_step_is_longer_than_its_divergence(rate, demonstrations):
    first = STOPS_SHORT.init(None)
    params, found = learned(make_env(), STOPS_SHORT, first, None, STATIC, rate, 2, demonstrations)
    played, metrics = found[1]
    alive = np.asarray(played.alive).reshape(-1)
    seen = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[alive], played.observation)
    before, after = (goes(x, None, None, seen, None) for x in (first, params))
    kl = float(policy_gradient.divergence(before, after))
    # One step at most was taken from below the limit; a batch is a sample of all decisions.
    limit = (policy_gradient.MAX_KL**0.5 + policy_gradient.STEP_KL**0.5) ** 2
    assert 0 < kl < 1.5 * limit and int(metrics["steps"]) > 3


def test_an_experience_is_what_happened(demonstrations):
    env = make_env()
    play = explore.make(env, STOPS_SHORT, None, (), STATIC)
    key = jax.random.key(1)
    played = play(STOPS_SHORT.init(None), None, None, starts(0), key, key)
    np.testing.assert_array_equal(played.reward.sum(1), played.success)
    assert played.alive[:, 0].all() and 0 < played.success.mean() < 1
    # Until the end, and never again.
    np.testing.assert_array_equal(np.diff(played.alive.astype(int), axis=1) > 0, False)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), played.observation)
    mean = goes(STOPS_SHORT.init(None), None, None, flat, None)
    noise = (played.action.reshape(mean.shape) - mean)[np.asarray(played.alive).reshape(-1)]
    assert abs(float(noise.std()) / explore.NOISE - 1) < 0.05 and abs(noise.mean()) < 1e-3


@pytest.mark.slow
def test_commands_stay_on_the_manifold_at_every_step_of_learning(demonstrations):
    settings = dataclasses.replace(
        fakes.TINY, learner="bc", options=BcConfig(mlp_width=16, mlp_blocks=1)
    )
    env = make_env()
    train = config.TrainConfig()
    policy = policies.make(methods.METHODS["stardiff"], settings, env.task, train)
    params = fakes.params(policy)
    static = explore.ExploreSettings(settings.obs_horizon, settings.execute, 4)
    box = normalizer.MinMax(-ACTION * jnp.ones(5), ACTION * jnp.ones(5))
    fields = normalizer.MinMax(-jnp.ones(12), jnp.ones(12))
    stats = normalizer.Normalizer(box, fields)
    after, found = learned(env, policy, params, stats, static, 1e-3, 4, demonstrations)
    worst = [float(played.rcm_commanded) for played, _ in found]
    assert max(worst) < 1e-6, worst
    moved = jax.tree.map(lambda x, y: float(jnp.abs(x - y).max()), params, after)
    assert max(jax.tree.leaves(moved)) > 1e-5  # steps of Adam, shortened to the divergence
    assert sum(int(metrics["steps"]) for _, metrics in found) > 0


def test_the_density_and_its_clipped_gain():
    mean = jnp.zeros((1, 2, 3))
    action = mean.at[0, 1, 2].set(explore.NOISE)
    assert float(policy_gradient.log_density(action, mean)[0]) == -0.5
    # The mean of the score is 0 where the actions are those of the policy.
    drawn = explore.NOISE * jax.random.normal(jax.random.key(0), (20_000, 1, 2))
    score = jax.grad(lambda m: policy_gradient.log_density(drawn, m).mean())(jnp.zeros((1, 2)))
    assert jnp.abs(explore.NOISE * score).max() < 0.03
    gain = policy_gradient.surrogate(jnp.log(jnp.array([1.0, 1.5, 1.5, 0.5, 0.5])),
                                     jnp.array([2.0, 1.0, -1.0, 1.0, -1.0]))  # fmt: skip
    np.testing.assert_allclose(gain, [2.0, 1.2, -1.5, 0.5, -0.8], atol=1e-6)
