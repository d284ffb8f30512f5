"""Policy gradient in closed loop: it learns, and its commands stay on the RCM manifold."""

import dataclasses
import types

import fakes
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import stubs

from starjax.addons.finetune import advantages, critic, explore, noise_level, policy_gradient
from starjax.core import config, methods
from starjax.core.types import Command, Pose
from starjax.data import normalizer
from starjax.policies import policy as policies
from starjax.policies.base import Policy
from starjax.policies.learners.onestep import OnestepConfig
from starjax.sim import wrists

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


def starts(first, count=COUNT):
    index = np.arange(count, dtype=np.int32) % 2
    trocar = type(TROCARS)(*(np.asarray(field)[index] for field in TROCARS))
    return explore.Starts(trocar, index, first + np.arange(count, dtype=np.int32))


def deviations(noise, count=COUNT):
    return np.full(count, noise, np.float32)


def learned(env, policy, params, stats, static, rate, iterations, demonstrations):
    """Returns the parameters after some iterations, and the experiences and metrics of all."""
    adam = policy_gradient.optimizer(rate)
    play = explore.make(env, policy, None, (), static)
    learn = policy_gradient.make(policy, adam, static, fakes.TINY.horizon)
    key, learning, found = jax.random.key(0), None, []
    for i in range(iterations):
        now = params if learning is None else learning.params
        here = jax.random.fold_in(key, i)
        played = play(now, None, stats, starts(i * COUNT), key, here, deviations(NOISE))
        if learning is None:
            learning = policy_gradient.begin(adam, params, key, played)
        learning, metrics = learn(learning, stats, played, NOISE, demonstrations, here, i > 0)
        found.append((played, metrics))
    return learning.params, found


SHORT = 0.9  # fraction of the path to a goal: near ones are reached
NOISE = 0.01
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


def _plan(params, goal):
    """A network's plan `[B, 8, 3]` for goals `[B, 3]`."""
    hidden = jnp.tanh(goal / 0.05 @ params["in"])
    return (hidden @ params["out"] + params["bias"]).reshape(-1, 8, 3)


def _aside(goal):
    """Plans `[B, 1, 3]` that end 3 to 7 mm from the goal."""
    u = goal / 0.05
    error = jnp.stack([jnp.cos(2 * u[:, 1]), jnp.sin(2 * u[:, 0] + 1), jnp.ones(len(u))], -1)
    return (goal + 0.004 * error)[:, None] / ACTION


def _trained_aside(key):
    """Parameters of a network that has learned `_aside`."""
    shapes = {"in": (3, 64), "out": (64, 24), "bias": (24,)}
    keys = zip(shapes.items(), jax.random.split(key, 3))
    params = {name: jax.random.normal(k, shape) / 8 for (name, shape), k in keys}
    goal = jax.random.uniform(key, (4096, 3), minval=-0.05, maxval=0.05)
    adam = optax.adam(1e-2)

    def step(i, carry):
        params, state = carry
        error = jax.grad(lambda p: jnp.mean((_plan(p, goal) - _aside(goal)) ** 2))(params)
        change, state = adam.update(error, state)
        return optax.apply_updates(params, change), state

    return jax.lax.fori_loop(0, 500, step, (params, adam.init(params)))[0]


@pytest.mark.slow
@pytest.mark.release
def test_a_network_whose_plans_end_aside_learns_to_arrive(demonstrations):
    def aims(params, stats, keys, observation, trocar):
        own = 0.005 * jax.vmap(lambda key: jax.random.normal(key, (8, 3)))(keys)
        return _plan(params, observation.state[:, -1, :3]) + own

    policy = STOPS_SHORT._replace(generate=aims)
    first = jax.jit(_trained_aside)(jax.random.key(0))
    params, found = learned(make_env(), policy, first, None, STATIC, 1e-3, 40, demonstrations)
    play, key = explore.make(make_env(), policy, None, (), STATIC), jax.random.key(9)
    quiet = [(None, None, starts(i * COUNT), key, key, deviations(0.0)) for i in range(4)]
    before, after = (np.mean([play(p, *x).success for x in quiet]) for p in (first, params))
    assert before < 0.75 and after > 0.93, (before, after)
    assert found[0][1]["steps"] == 0 and float(found[0][1]["kl"]) < 1e-9  # the critic alone


@pytest.mark.slow
@pytest.mark.parametrize("rate", [1e-3, 10.0])
def test_no_step_is_longer_than_its_divergence(rate, demonstrations):
    first = STOPS_SHORT.init(None)
    params, found = learned(make_env(), STOPS_SHORT, first, None, STATIC, rate, 2, demonstrations)
    played, metrics = found[1]
    alive = np.asarray(played.alive).reshape(-1)
    seen = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[alive], played.observation)
    before, after = (goes(x, None, None, seen, None) for x in (first, params))
    kl = float(policy_gradient.divergence(before, after, NOISE))
    # One step at most was taken from below the limit; a batch is a sample of all decisions.
    limit = (policy_gradient.MAX_KL**0.5 + policy_gradient.STEP_KL**0.5) ** 2
    assert 0 < kl < 1.5 * limit and int(metrics["steps"]) > 3


def test_an_experience_is_what_happened(demonstrations):
    env = make_env()
    play = explore.make(env, STOPS_SHORT, None, (), STATIC)
    key = jax.random.key(1)
    played = play(STOPS_SHORT.init(None), None, None, starts(0), key, key, deviations(NOISE))
    np.testing.assert_array_equal(played.reward.sum(1), played.success)
    assert played.alive[:, 0].all() and 0 < played.success.mean() < 1
    # Until the end, and never again.
    np.testing.assert_array_equal(np.diff(played.alive.astype(int), axis=1) > 0, False)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), played.observation)
    mean = goes(STOPS_SHORT.init(None), None, None, flat, None)
    noise = (played.action.reshape(mean.shape) - mean)[np.asarray(played.alive).reshape(-1)]
    assert abs(float(noise.std()) / NOISE - 1) < 0.05 and abs(noise.mean()) < 1e-3
    np.testing.assert_allclose(noise, noise[:, :1].repeat(8, 1), atol=1e-6)  # a whole plan


@pytest.mark.slow
@pytest.mark.release
def test_commands_stay_on_the_manifold_at_every_step_of_learning(demonstrations):
    settings = dataclasses.replace(
        fakes.TINY,
        learner="onestep",
        options=OnestepConfig(unet_channels=(16,), time_dim=16, groups=4),
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


@pytest.mark.slow
def test_the_manifold_of_a_wrist_is_that_of_its_shaft():
    env = make_env()
    slots = tuple(slot._replace(tool="needle_driver") for slot in env.task.slots)
    env = env._replace(task=env.task._replace(slots=slots))

    def bends(params, stats, actions, observation, trocar):
        command = moves(params, stats, actions, observation, trocar)
        return wrists.through(env.task, command, trocar.p_world_trocar[:, None])

    policy = STOPS_SHORT._replace(execute=bends)
    play = explore.make(env, policy, None, (), STATIC)
    params, key = STOPS_SHORT.init(None), jax.random.key(0)
    played = play(params, None, None, starts(0), key, key, deviations(NOISE))
    assert played.rcm_commanded < 1e-6


def test_the_density_and_its_clipped_gain():
    plan = jnp.zeros((1, 2, 3))
    action = plan.at[0, :, 2].set(jnp.array([0.5, 1.5]) * NOISE)
    assert float(policy_gradient.log_density(action, plan, NOISE)[0]) == -0.5
    # A plan that is displaced as a whole: the divergence is that of the density.
    moved = plan + jnp.array([0.1, 0.0, -0.2]) * NOISE
    np.testing.assert_allclose(policy_gradient.divergence(plan, moved, NOISE), 0.025, rtol=1e-5)
    # The mean of the score is 0 where the actions are those of the policy.
    drawn = NOISE * jax.random.normal(jax.random.key(0), (20_000, 1, 2))
    score = jax.grad(lambda m: policy_gradient.log_density(drawn, m, NOISE).mean())
    assert jnp.abs(NOISE * score(jnp.zeros((1, 2)))).max() < 0.03
    gain = policy_gradient.surrogate(jnp.log(jnp.array([1.0, 1.5, 1.5, 0.5, 0.5])),
                                     jnp.array([2.0, 1.0, -1.0, 1.0, -1.0]))  # fmt: skip
    np.testing.assert_allclose(gain, [2.0, 1.2, -1.5, 0.5, -0.8], atol=1e-6)


BATCH = 1024  # episodes of an iteration, as on a GPU
ENDS_ASIDE = STOPS_SHORT._replace(
    init=lambda key: {"aside": jnp.array([0.003, -0.001, 0.0])},  # m; the tolerance is 4 mm
    generate=lambda params, stats, keys, seen, trocar: jnp.broadcast_to(
        ((seen.state[:, -1, :3] + params["aside"]) / ACTION)[:, None], (len(keys), 8, 3)
    ),
)


@pytest.mark.release
def test_the_estimate_is_the_derivative_of_success():
    """By differences of the share of success, of the same starts with the same noise."""
    play = explore.make(make_env(), ENDS_ASIDE, None, (), STATIC)
    noise, key, params = deviations(NOISE, BATCH), jax.random.key(2), ENDS_ASIDE.init(None)

    def played(aside, i):
        here = jax.random.fold_in(key, i)
        return play({"aside": aside}, None, None, starts(i * BATCH, BATCH), key, here, noise)

    @jax.jit
    def estimated(value, found):
        """Returns the gradient of a batch, and the critic after some steps on it."""
        guess = critic.values(value, found.seen)
        estimates = advantages.estimate(found.reward, guess, found.alive)
        flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), found)

        def gain(params):
            plan = ENDS_ASIDE.generate(params, None, flat.key, flat.observation, None)
            log = policy_gradient.log_density(flat.action, plan, NOISE)
            log_ratio = log - jax.lax.stop_gradient(log)
            each = policy_gradient.surrogate(log_ratio, estimates.advantage.reshape(-1))
            return each.sum() / BATCH

        seen, returns = flat.seen[::8], estimates.returns.reshape(-1)[::8]
        steps = lambda _, value: critic.step(value, seen, returns)  # noqa: E731
        return jax.grad(gain)(params)["aside"], jax.lax.fori_loop(0, 30, steps, value)

    first = played(params["aside"], 0)
    value, gradients = critic.begin(key, first.seen, first.alive), []
    for i in range(30):
        gradient, value = estimated(value, played(params["aside"], i))
        gradients.append(gradient)
    learned = np.array(gradients[6:])  # the critic has begun to tell states apart
    error = learned.std(0)
    half = 5e-4  # m
    low, high = (
        [
            np.mean([played(params["aside"] + sign * half * axis, i).success for i in range(8)])
            for axis in np.eye(3, dtype=np.float32)
        ]
        for sign in (-1, 1)
    )
    slope = (np.array(high) - low) / (2 * half)
    doubt = 3 * error.max() / len(learned) ** 0.5
    np.testing.assert_allclose(learned.mean(0), slope, rtol=0.15, atol=doubt)
    # Even the batch of a single iteration has the sign of the largest one.
    assert slope[0] < -2 * error[0]


def test_the_noise_used_is_the_most_that_success_bears():
    def tried(*rates):
        return [{"noise": n, "rate": r} for n, r in zip(noise_level.LEVELS, rates, strict=True)]

    assert noise_level.chosen(tried(0.8, 0.8, 0.75, 0.7, 0.6)) == 1.0
    assert noise_level.chosen(tried(0.8, 0.5, 0.4, 0.3, 0.2)) == 0.25
    assert noise_level.chosen(tried(0.8, 0.9, 0.8, 0.8, 0.8)) == 2.0
    repeated, level = noise_level.repeated(starts(7, 64))
    for n in range(len(noise_level.LEVELS)):  # every level has the same starts
        np.testing.assert_array_equal(repeated.trial[level == n][:12], 7 + np.arange(12))
    np.testing.assert_array_equal(repeated.index, (repeated.trial - 7) % 2)
    np.testing.assert_array_equal(
        repeated.trocar.radius, starts(0, 64).trocar.radius[repeated.index]
    )
