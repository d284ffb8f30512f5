"""Training images meet the disturbances of `starjax stress`, drawn anew for every sample."""

import dataclasses

import fakes
import jax
import jax.numpy as jnp
import mistakes
import numpy as np
import pytest
import stubs

from starjax import config
from starjax.commands import checks
from starjax.data import normalizer, windows
from starjax.evaluation.disturbances import DISTURBANCES, base
from starjax.methods import METHODS
from starjax.policies import policy as policies
from starjax.sim.state import EnvParams
from starjax.training import devices, randomise, state, step
from starjax.training.sharding import StateLayout

KEY = jax.random.key(5)
LEVELS = {"darkness": 0.5, "tint": 0.4, "smoke": 0.5, "blood": 0.2, "blur": 2.0, "noise": 0.1}
ALL = tuple(f"{name}={level}" for name, level in LEVELS.items())
SETTINGS = config.TrainConfig(steps=2, batch_size=4, randomise=ALL)
SAMPLES = 64


def images(count=2, size=32):
    shape = (count, size, size, 3)
    pixels = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    return {"camera": jnp.asarray(pixels)}


def observation(**changed):
    """Returns that of `SAMPLES` equal samples with two equal images each."""
    image = images(1)["camera"][0]
    batch = jnp.broadcast_to(image, (SAMPLES, 2, *image.shape))
    seen = fakes.dataset(seed=0, demos=1, length=10).observation
    return seen._replace(gripper=jnp.zeros((SAMPLES, 2, 1)), images={"camera": batch}, **changed)


def disturbed(*names):
    settings = config.TrainConfig(randomise=names)
    change = jax.jit(lambda key, seen: randomise.randomise(settings, key, seen))
    return np.asarray(change(KEY, observation()).images["camera"])


def test_without_names_the_observation_is_the_same_object():
    seen = observation()
    assert randomise.randomise(config.TrainConfig(), KEY, seen) is seen


def test_at_level_0_images_stay_as_they_are():
    levels = dict.fromkeys(LEVELS, jnp.float32(0.0))
    changed = jax.jit(randomise.disturb_images)(levels, KEY, images())
    np.testing.assert_array_equal(changed["camera"], images()["camera"])


@pytest.mark.parametrize("names", [[name] for name in LEVELS] + [list(LEVELS)], ids="-".join)
def test_images_are_those_of_a_stressed_episode_with_the_same_key(names):
    levels = {name: LEVELS[name] for name in names}
    inner = stubs.make_env("image", unlucky=0.0)
    env = base.with_disturbances(inner, names)
    trocar = jax.tree.map(lambda x: x[0], stubs.trocars(4))
    first = env.reset(KEY, EnvParams(trocar, levels=levels))
    episode = [first, first.replace(step=first.step + 1)]
    plain = jnp.stack([inner.observe(s).images["camera"] for s in episode])
    stressed = jnp.stack([env.observe(s).images["camera"] for s in episode])
    drawn = {name: jnp.float32(level) for name, level in levels.items()}
    changed = randomise.disturb_images(drawn, KEY, {"camera": plain})["camera"]
    # Another program may round a value at one half to the other side.
    np.testing.assert_allclose(changed.astype(int), stressed.astype(int), atol=1)
    assert np.mean(changed == stressed) > 0.98


@pytest.mark.parametrize("name", [name for name in LEVELS if name != "noise"])
def test_both_images_of_a_sample_share_what_is_on_the_lens_and_samples_differ(name):
    changed = disturbed(f"{name}={LEVELS[name]}")
    np.testing.assert_array_equal(changed[:, 0], changed[:, 1])
    assert len(np.unique(changed.reshape(SAMPLES, -1), axis=0)) > (2 if name == "blur" else 8)


def test_each_image_has_its_own_noise_and_half_of_the_samples_have_none():
    changed = disturbed("noise=0.1")
    noisy = np.any(changed != np.asarray(observation().images["camera"]), axis=(1, 2, 3, 4))
    assert 0.3 < noisy.mean() < 0.7
    assert np.all(np.any(changed[noisy, 0] != changed[noisy, 1], axis=(1, 2, 3)))


def test_levels_are_zero_half_the_time_and_else_uniform():
    draw = jax.vmap(lambda key: randomise.draw_levels(key, LEVELS))
    levels = draw(jax.random.split(KEY, 4096))
    for name, highest in LEVELS.items():
        fraction = np.asarray(levels[name]) / highest
        assert np.mean(fraction == 0.0) == pytest.approx(0.5, abs=0.04)
        assert np.mean(fraction[fraction > 0.0]) == pytest.approx(0.5, abs=0.03)
        assert fraction.max() <= 1.0
    both = np.mean((levels["smoke"] > 0.0) & (levels["blood"] > 0.0))
    assert both == pytest.approx(0.25, abs=0.04)  # independent


def test_a_step_learns_from_disturbed_images():
    small = dataclasses.replace(fakes.TINY, observation="image")
    dataset = fakes.dataset(seed=0, demos=2, length=20, image_size=32)
    frames = np.arange(20)
    stats = normalizer.fit(METHODS["stardiff"], fakes.TASK, dataset, frames)
    batch = windows.gather(dataset, jnp.arange(4), small.obs_horizon, small.horizon)
    after = {}
    for names in ((), ALL):
        settings = dataclasses.replace(SETTINGS, randomise=names)
        policy = policies.make(METHODS["stardiff"], small, fakes.TASK, settings)
        optimizer = state.make_optimizer(settings)
        params = fakes.params(policy)
        first = state.create(policy, optimizer, params, stats, state.streams(0).steps)
        layout = StateLayout(devices.make_mesh(4), policy.cast_params, first)
        setup = step.Setup(policy, optimizer, small, settings, layout)
        take = jax.jit(lambda carry, batch, setup=setup: step.train_step(setup, carry, batch))
        after[names] = take(layout.to_carry(first), batch).state
    losses = [float(it.sums["loss"]) for it in after.values()]
    assert all(int(it.skipped) == 0 for it in after.values()) and np.isfinite(losses).all()
    assert losses[0] != losses[1]


@pytest.mark.parametrize(
    "name", [name for name in DISTURBANCES.built_in if DISTURBANCES.get(name).on_image is None]
)
def test_disturbances_of_something_else_are_refused(name):
    with mistakes.of("train.randomise", name):
        randomise.max_levels(config.TrainConfig(randomise=(f"{name}=1",)))


def test_levels_above_the_maximum_are_refused():
    with mistakes.of("train.randomise", 1.5):
        randomise.max_levels(config.TrainConfig(randomise=("smoke=1.5",)))


@pytest.mark.parametrize(
    "changes",
    [
        {"observation": "state"},
        {"freeze_encoder": True, "encoder_weights": "compact"},
    ],
)
def test_policies_whose_training_reads_no_images_refuse_it(changes):
    policy = dataclasses.replace(config.PolicyConfig(), **changes)
    checks.check(config.RunConfig(policy=policy))
    with mistakes.of("train.randomise"):
        checks.check(config.RunConfig(policy=policy, train=SETTINGS))


def test_it_determines_the_weights_and_survives_json():
    plain, other = config.RunConfig(), config.RunConfig(train=SETTINGS)
    before, now = map(config.weight_settings, (plain, other))
    assert before["train.randomise"] == [] and now["train.randomise"] == list(ALL)
    assert config.from_dict(config.RunConfig, config.as_json(other)) == other
    old = config.as_json(plain)
    del old["train"]["randomise"]  # a file of an earlier version
    assert config.from_dict(config.RunConfig, old) == plain
