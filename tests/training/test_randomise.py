"""Training meets the disturbances of `starjax stress`, drawn anew for every sample."""

import dataclasses
from typing import Any

import fakes
import jax
import jax.numpy as jnp
import mistakes
import numpy as np
import pytest
import stubs

from starjax.cli import pipeline
from starjax.core import config, config_json
from starjax.core.types import Command, Observation, Pose
from starjax.data import windows
from starjax.evaluation.disturbances import base, parse_levels
from starjax.sim.state import EnvParams
from starjax.training import randomise

KEY = jax.random.key(5)
LEVELS = {"darkness": 0.5, "tint": 0.4, "smoke": 0.5, "blood": 0.2, "blur": 2.0, "noise": 0.1}
ALL = tuple(f"{name}={level}" for name, level in LEVELS.items())
SETTINGS = config.TrainConfig(steps=2, batch_size=4, randomise=ALL)
TIMING = {"observation_delay": 3.0, "observation_dropout": 0.6}
SAMPLES = 64


def images(count=2, size=32):
    shape = (count, size, size, 3)
    pixels = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    return {"camera": jnp.asarray(pixels)}


def observation() -> Any:
    """Returns that of `SAMPLES` equal samples with two equal images each."""
    image = images(1)["camera"][0]
    batch = jnp.broadcast_to(image, (SAMPLES, 2, *image.shape))
    seen = fakes.dataset(seed=0, demos=1, length=10).observation
    return seen._replace(gripper=jnp.zeros((SAMPLES, 2, 1)), images={"camera": batch})


def disturbed(*names, steps=(0, 1)):
    levels = parse_levels("", names)
    seen = jnp.broadcast_to(jnp.array(steps), (SAMPLES, 2))

    @jax.jit
    def change(key, before):
        draws = randomise.draw(levels, key, SAMPLES, SAMPLES)
        return randomise.disturb(list(levels), draws, seen, before)

    return np.asarray(change(KEY, observation()).images["camera"])


def drawn(levels, share=4096):
    """Fractions of the maximum levels of `share` samples, by name."""
    level = jax.jit(lambda key: randomise.draw(levels, key, share, share).level)(KEY)
    return {name: np.asarray(level[:, i]) / levels[name] for i, name in enumerate(levels)}


def test_without_names_the_observation_is_the_same_object():
    seen = observation()
    assert randomise.disturb([], randomise.Draws(jnp.zeros((4, 0)), KEY), KEY, seen) is seen


def test_at_level_0_images_stay_as_they_are():
    draws = randomise.Draws(jnp.zeros(len(LEVELS)), KEY)
    change = jax.jit(
        lambda draws: randomise.disturb_images([*LEVELS], draws, jnp.arange(2), images())
    )
    np.testing.assert_array_equal(change(draws)["camera"], images()["camera"])


@pytest.mark.parametrize("names", [[name] for name in LEVELS] + [list(LEVELS)], ids="-".join)
def test_images_are_those_of_a_stressed_episode_with_the_same_key(names):
    levels = {name: LEVELS[name] for name in names}
    inner: Any = stubs.make_env("image", unlucky=0.0)
    env = base.with_disturbances(inner, names)
    trocar = jax.tree.map(lambda x: x[0], stubs.trocars(4))
    first = env.reset(KEY, EnvParams(trocar, levels=levels))
    episode = [first, first.replace(step=first.step + 1)]
    plain = jnp.stack([inner.observe(s).images["camera"] for s in episode])
    stressed = jnp.stack([(env.observe(s).images or {})["camera"] for s in episode])
    draws = randomise.Draws(jnp.array(list(levels.values())), KEY)
    found = randomise.disturb_images(names, draws, jnp.arange(2), {"camera": plain})["camera"]
    # Another program may round a value at one half to the other side.
    np.testing.assert_allclose(found.astype(int), stressed.astype(int), atol=1)
    assert np.mean(found == stressed) > 0.98


@pytest.mark.parametrize("name", [name for name in LEVELS if name != "noise"])
def test_both_images_of_a_sample_share_what_is_on_the_lens_and_samples_differ(name):
    changed = disturbed(f"{name}={LEVELS[name]}")
    np.testing.assert_array_equal(changed[:, 0], changed[:, 1])
    assert len(np.unique(changed.reshape(SAMPLES, -1), axis=0)) > (2 if name == "blur" else 8)


def test_each_step_has_its_own_noise():
    usual = np.asarray(observation().images["camera"])
    apart, same = disturbed("noise=0.1"), disturbed("noise=0.1", steps=(3, 3))
    noisy = np.any(apart != usual, axis=(1, 2, 3, 4))
    assert np.all(np.any(apart[noisy, 0] != apart[noisy, 1], axis=(1, 2, 3)))
    np.testing.assert_array_equal(same[:, 0], same[:, 1])  # one image, seen twice


def test_half_of_the_samples_are_untouched_and_the_others_have_half_of_the_disturbances():
    changed, usual = disturbed(*ALL), np.asarray(observation().images["camera"])
    np.testing.assert_array_equal(changed[SAMPLES // 2 :], usual[SAMPLES // 2 :])
    fractions = drawn(LEVELS | {"camera": 10.0, "observation_delay": 4.0})
    for name, fraction in fractions.items():
        on = fraction > 0.0
        assert not on[2048:].any() and fraction.max() <= 1.0
        assert np.mean(on[:2048]) == pytest.approx(0.5, abs=0.04)
        assert np.mean(fraction[on]) == pytest.approx(0.5, abs=0.03)
        assert name != "camera" or on[:1024].all()  # a fixed number of images to draw
    both = np.mean((fractions["smoke"] > 0.0) & (fractions["blood"] > 0.0))
    assert both == pytest.approx(0.125, abs=0.03)  # independent


def test_every_device_has_the_same_number_of_disturbed_samples():
    levels = {"camera": 10.0, "smoke": 0.5}
    level = np.asarray(randomise.draw(levels, KEY, 32, 8).level).reshape(4, 8, 2)
    np.testing.assert_array_equal(level[..., 0] > 0, np.tile(np.arange(8) < 2, (4, 1)))
    assert not level[:, 4:].any()


@pytest.mark.parametrize("names", [[name] for name in TIMING] + [list(TIMING), list(TIMING)[::-1]])
def test_windows_are_those_of_a_stressed_episode_with_the_same_key(names):
    inner: Any = stubs.make_env(unlucky=0.0)
    env, levels = base.with_disturbances(inner, names), {name: TIMING[name] for name in names}
    trocar = jax.tree.map(lambda x: x[0], stubs.trocars(4))
    state = jax.jit(env.reset)(KEY, EnvParams(trocar, levels=levels))
    step, episode, stressed = jax.jit(env.step), [], []
    for number in range(12):
        episode.append(state.pose.p)
        stressed.append(env.observe(state).pose.p)
        to = state.pose.p + 0.001 * (1 + number)
        state = step(state, Command(Pose(state.pose.R, to), state.gripper))
    still = jnp.broadcast_to(jnp.eye(3), (12, 1, 3, 3))
    dataset = fakes.dataset(seed=0, demos=1, length=12).replace(
        observation=Observation(Pose(still, jnp.stack(episode)), jnp.zeros((12, 1)))
    )
    frame = jnp.arange(12)
    level = jnp.broadcast_to(jnp.array(list(levels.values())), (12, len(levels)))
    draws = randomise.Draws(level, jnp.broadcast_to(KEY, (12,)))
    at = windows.control_steps(dataset, frame)
    seen = jax.jit(lambda draws, at: randomise.seen_steps(names, draws, at, 2))(draws, at)
    batch, plain = (windows.gather(dataset, frame, 2, 4, steps) for steps in (seen, None))
    shown = np.stack(stressed)
    np.testing.assert_array_equal(batch.observation.pose.p[:, 1], shown)
    np.testing.assert_array_equal(batch.observation.pose.p[1:, 0], shown[:-1])
    assert not np.array_equal(batch.observation.pose.p, plain.observation.pose.p)
    np.testing.assert_array_equal(batch.command.pose.p, plain.command.pose.p)


@pytest.mark.parametrize("name", ["trocar_offset", "breathing", "action_delay", "mass"])
def test_disturbances_of_physics_and_trocars_are_refused(name):
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
def test_policies_whose_training_reads_no_images_refuse_those_of_images(changes):
    policy = dataclasses.replace(config.PolicyConfig(), **changes)
    timing = config.TrainConfig(randomise=("observation_delay=4",))
    assert randomise.max_levels(timing, policy) == {"observation_delay": 4.0}
    for name in ("camera", "smoke"):
        settings = config.TrainConfig(randomise=("observation_delay=4", f"{name}=0.5"))
        with mistakes.of("train.randomise"):
            pipeline._check(policy, settings, ())


def test_it_determines_the_weights_and_survives_json():
    plain, other = config.RunConfig(), config.RunConfig(train=SETTINGS)
    before, now = map(config_json.weight_settings, (plain, other))
    assert before["train.randomise"] == [] and now["train.randomise"] == list(ALL)
    assert config_json.from_dict(config.RunConfig, config_json.as_json(other)) == other
    old = config_json.as_json(plain)
    del old["train"]["randomise"]  # a file of an earlier version
    assert config_json.from_dict(config.RunConfig, old) == plain
