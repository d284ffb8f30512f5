"""The training step: one program, nothing lost to a broken loss, the right frames."""

import dataclasses
import types
from typing import Any

import chex
import fakes
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.core import config
from starjax.core.methods import METHODS
from starjax.data import normalizer, windows
from starjax.policies import policy as policies
from starjax.policies.base import Policy
from starjax.runtime import xla
from starjax.training import devices, state, step
from starjax.training.sharding import Setup, StateLayout

STRICT = {
    "promotion of types": lambda: jax.numpy_dtype_promotion("strict"),
    "promotion of ranks": lambda: jax.numpy_rank_promotion("raise"),
}
SETTINGS = config.TrainConfig(
    steps=300, batch_size=8, learning_rate=0.1, warmup_steps=0, weight_decay=0.0
)


def regression():
    """A policy of one parameter that learns the mean position; its loss is NaN on request."""

    def init(key):
        return {"w": jax.random.normal(key, (3,))}

    def loss(params, batch):
        error = jnp.mean((params["w"] - batch.command.pose.p) ** 2)
        broken = jnp.mean(batch.observation.gripper) > 1.5
        return jnp.where(broken, jnp.nan, error), {"error": error}

    return Policy(init, lambda stats, key, batch: batch, loss, lambda *_: None, ("error",))


@pytest.fixture(scope="module")
def dataset():
    return fakes.dataset(seed=0, demos=4, length=20)


def begun(policy, optimizer, stats):
    """The state before the first step."""
    streams = state.streams(0)
    drawn = state.init(policy, streams.params).drawn()
    return state.create(policy, optimizer, drawn, stats, streams.steps)


@pytest.fixture
def start():
    policy, optimizer = regression(), state.make_optimizer(SETTINGS)
    box = normalizer.MinMax(-jnp.ones(5), jnp.ones(5))
    stats = normalizer.Normalizer(box, None)
    first = begun(policy, optimizer, stats)
    return policy, optimizer, devices.replicate(first, devices.make_mesh(SETTINGS.batch_size))


def layout(shapes, policy=None):
    return StateLayout(
        devices.make_mesh(SETTINGS.batch_size), (policy or regression()).cast_params, shapes
    )


def program(policy, optimizer):
    def run(state, dataset, frames, count):
        it = layout(state)
        setup = Setup(policy, optimizer, fakes.TINY, SETTINGS, it)
        return it.to_state(
            step.resident_steps(setup, it.to_carry(state), dataset, frames, len(frames), count)
        )

    return run


def test_any_number_of_steps_is_one_trace(start, dataset):
    policy, optimizer, first = start
    run = chex.assert_max_traces(program(policy, optimizer), n=1)
    run = jax.jit(run, donate_argnums=0)
    now = first
    for count in (1, 3, 7):
        now = run(now, dataset, jnp.arange(80), jnp.int32(count))
    assert int(now.step) == 11
    with pytest.raises(RuntimeError, match="deleted"):
        np.asarray(first.params["w"])  # its memory was given away


def test_steps_do_not_depend_on_how_they_are_called(start, dataset):
    policy, optimizer, first = start
    run = jax.jit(program(policy, optimizer))
    once = run(first, dataset, jnp.arange(80), jnp.int32(6))
    twice = run(first, dataset, jnp.arange(80), jnp.int32(2))
    twice = run(twice, dataset, jnp.arange(80), jnp.int32(4))
    chex.assert_trees_all_equal(once.params, twice.params)
    chex.assert_trees_all_equal(once.sums, twice.sums)


def test_it_learns_the_given_frames_only(start, dataset):
    policy, optimizer, first = start
    run = jax.jit(program(policy, optimizer))
    last = run(first, dataset, jnp.arange(20, 40), jnp.int32(300))
    wanted = np.asarray(dataset.command.pose.p[20:40, 0]).mean(0)
    np.testing.assert_allclose(last.params["w"], wanted, atol=0.05)


@pytest.mark.slow
def test_matrices_rounded_by_the_step_before_are_those_of_the_parameters(dataset):
    small = dataclasses.replace(fakes.TINY, dtype="bfloat16")
    settings = dataclasses.replace(SETTINGS, learning_rate=1e-3)
    policy = policies.make(METHODS["stardiff"], small, fakes.TASK, settings)
    optimizer = state.make_optimizer(settings)
    stats = normalizer.fit(METHODS["stardiff"], fakes.TASK, dataset, np.arange(80))
    first = begun(policy, optimizer, stats)
    it = layout(first, policy)
    setup = Setup(policy, optimizer, small, settings, it)
    frames, nothing = jnp.arange(80), jax.tree.map(lambda _: None, first.params)

    @jax.jit
    def unrounded(carry):
        after = step.resident_step(
            setup, carry._replace(rounded=nothing), dataset, frames, len(frames)
        )
        return after._replace(rounded=nothing)

    many = jax.jit(lambda c, n: step.resident_steps(setup, c, dataset, frames, len(frames), n))
    called = it.to_carry(first)
    for _ in range(3):
        called = unrounded(called)
    looped, called = it.to_state(many(it.to_carry(first), 3)), it.to_state(called)
    chex.assert_trees_all_close((looped.params, looped.sums), (called.params, called.sums))
    moved = jax.tree.map(lambda a, b: float(jnp.abs(a - b).max()), looped.params, first.params)
    assert min(jax.tree.leaves(moved)) > 5e-4  # sum of three steps of the learning rate


def test_a_broken_loss_is_left_out_and_counted(start, dataset):
    policy, optimizer, first = start
    it = layout(first)
    setup = Setup(policy, optimizer, fakes.TINY, SETTINGS, it)
    once = jax.jit(lambda s, b: it.to_state(step.train_step(setup, it.to_carry(s), b)))
    good = windows.gather(dataset, jnp.arange(8), 2, 16)
    bad = good.replace(observation=good.observation._replace(gripper=jnp.full((8, 2), 2.0)))
    before = once(first, good)
    after = once(before, bad)
    assert int(after.step) == 2 and int(after.skipped) == 1
    chex.assert_trees_all_equal(after.params, before.params)
    chex.assert_trees_all_equal(after.ema_params, before.ema_params)
    chex.assert_trees_all_equal(after.opt_state, before.opt_state)
    assert float(after.sums["skipped"]) == 1.0
    assert float(after.sums["loss"]) == float(before.sums["loss"])
    again = once(after, good)
    assert np.isfinite(again.params["w"]).all()
    assert not np.array_equal(again.params["w"], after.params["w"])


def test_the_average_forgets_its_beginning_as_the_paper_says(start, dataset):
    policy, optimizer, before = start
    run = jax.jit(program(policy, optimizer))
    for step_before in range(5):
        after = run(before, dataset, jnp.arange(80), jnp.int32(1))
        kept = 1 - (1 + step_before) ** -0.75
        wanted = kept * before.ema_params["w"] + (1 - kept) * after.params["w"]
        np.testing.assert_allclose(after.ema_params["w"], wanted, rtol=1e-4, atol=1e-6)
        before = after


def test_norm_is_of_every_entry():
    shapes = {"matrix": (300, 400), "flat": (70_001,), "small": (5, 7), "vector": (3,)}
    random = np.random.default_rng(0)
    gradients = {name: random.normal(size=shape) for name, shape in shapes.items()}
    wanted = np.linalg.norm(np.concatenate([g.ravel() for g in gradients.values()]))
    found = layout(None).norm(jax.tree.map(jnp.asarray, gradients))
    np.testing.assert_allclose(found, wanted, rtol=1e-5)


def test_mesh_divides_the_batch():
    assert devices.make_mesh(8).size == 1
    assert devices.make_mesh(7, jax.devices()).size == 1


def test_options_of_devices_are_known_to_this_xla():
    gpu, cpu = (types.SimpleNamespace(platform=name) for name in ("gpu", "cpu"))

    def options(*on):
        mesh: Any = types.SimpleNamespace(size=len(on), devices=np.array(on))
        return devices.compiler_options(mesh)

    assert options(gpu) == {}
    assert options(gpu, gpu)
    assert options(cpu) == options(cpu, cpu) == xla.options_without_kinematics()
    # an option that XLA does not know is an error at compilation
    jax.jit(lambda x: x + 1, compiler_options=options(gpu, gpu))(1)
    jax.jit(lambda x: x + 1, compiler_options=options(cpu))(1)


def test_a_gradient_that_is_not_finite_is_left_out_too(start, dataset):
    policy, _, first = start

    def loss(params, batch):
        return jnp.sqrt(jnp.sum(jnp.square(params["w"] - params["w"]))), {"error": jnp.float32(0)}

    optimizer = state.make_optimizer(SETTINGS)
    run = jax.jit(program(policy._replace(loss=loss), optimizer))
    after = run(first, dataset, jnp.arange(80), jnp.int32(1))
    assert int(after.skipped) == 1 and float(after.sums["gradient_norm"]) == 0.0
    chex.assert_trees_all_equal(after.params, first.params)


def test_every_step_has_keys_of_its_own():
    keys = jax.vmap(lambda s: jnp.stack(state.step_keys(jax.random.key(0), s)))(jnp.arange(50))
    assert len({bytes(x) for x in np.asarray(jax.random.key_data(keys)).reshape(100, -1)}) == 100


@pytest.mark.parametrize("mode", STRICT)
def test_a_step_is_traced_in_every_strict_mode(mode):
    settings = dataclasses.replace(fakes.TINY, observation="image")
    data = fakes.dataset(seed=0, demos=2, length=20, image_size=settings.image_size)
    policy = policies.make(METHODS["stardiff"], settings, fakes.TASK, SETTINGS)
    optimizer = state.make_optimizer(SETTINGS)
    stats = normalizer.fit(METHODS["stardiff"], fakes.TASK, data, np.arange(40))

    def run():
        streams = state.streams(0)
        params = policy.init(streams.params)
        first = state.create(policy, optimizer, params, stats, streams.steps)
        it = layout(first)
        setup = Setup(policy, optimizer, settings, SETTINGS, it)
        frames, count = jnp.arange(40, dtype=jnp.int32), jnp.int32(3)
        return it.to_state(
            step.resident_steps(setup, it.to_carry(first), data, frames, len(frames), count)
        )

    wanted = jax.eval_shape(run)
    with STRICT[mode]():
        chex.assert_trees_all_equal(jax.eval_shape(run), wanted)
