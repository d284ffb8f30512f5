"""A learner is added by adding: one from outside works with every method, command and file."""

import dataclasses
import importlib.metadata
import subprocess
import sys

import fakes
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy_learner

from starjax import deploy, rcm
from starjax.cli import options, run_settings
from starjax.core import config, config_json, errors, learners
from starjax.core.methods import METHODS
from starjax.data import normalizer, windows
from starjax.policies import policy as policies
from starjax.policies import policy_file
from starjax.sim import registries
from starjax.training import loop

TRAIN = config.TrainConfig(
    steps=4, batch_size=8, warmup_steps=1, checkpoint_every=2, log_every=2, holdout_demos=1
)


@pytest.fixture(autouse=True, scope="module")
def installed():
    """The toy learner's package is installed: its entry point is found."""
    found = importlib.metadata.entry_points
    toy = importlib.metadata.EntryPoint("toy", "toy_learner:TOY", "starjax.learners")

    def entry_points(**asked):
        return [*found(**asked), *([toy] if asked.get("group") == toy.group else [])]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(importlib.metadata, "entry_points", entry_points)
        tasks = registries.Registry("task", {"peg_transfer": "fakes:TASK"})
        patch.setattr(registries, "tasks", tasks)
        yield


def toy(**changed):
    return dataclasses.replace(config.with_learner(fakes.TINY, "toy"), **changed)


@pytest.mark.parametrize("name", ["dp_ee", "stardiff"])
def test_each_kind_of_policy_works_with_it(name):
    dataset = fakes.dataset(seed=0, demos=4, length=20, arms=2)
    policy = policies.make(METHODS[name], toy(), fakes.TWO_ARMS, TRAIN)
    stats = normalizer.fit(METHODS[name], fakes.TWO_ARMS, dataset, np.arange(60))
    params = jax.jit(policy.init)(jax.random.key(0))
    batch = windows.gather(dataset, jnp.array([3, 25, 70]), 2, 16)

    def loss(params):
        return policy.loss(params, policy.prepare(stats, jax.random.key(0), batch))

    (value, metrics), gradient = jax.jit(jax.value_and_grad(loss, has_aux=True))(params)
    assert np.isfinite(value) and metrics.keys() == set(policy.metrics) >= {"worst"}
    assert np.abs(gradient["learner"]["map"]).max() > 0
    ready, keys = policy.prepare_for_inference(params), jax.random.split(jax.random.key(1), 3)
    command = jax.jit(policy.sample)(ready, stats, keys, batch.observation, batch.trocar)
    error = rcm.rcm_error(command.pose, batch.trocar.p_world_trocar[:, None])
    assert (float(error.max()) <= 1e-6) == (name != "dp_ee")


@pytest.mark.slow
def test_it_is_trained_stored_and_deployed(tmp_path):
    given = METHODS["stardiff"], toy(), TRAIN, fakes.dataset(seed=0), fakes.TASK
    state = loop.run(*given, tmp_path, 0).state
    assert int(state.step) == 4
    path = tmp_path / "policy.safetensors"
    made = fakes.trained(policy=toy(), params=state.ema_params, normalizer=state.normalizer)
    policy_file.save(path, made)
    found = policy_file.load(path)
    assert found.policy == toy() and found.policy.options == toy_learner.ToyConfig(time_dim=16)
    deployed = deploy.load(path, gain=2.0)
    assert deployed.settings.options.gain == 2.0
    trocar = jax.tree.map(lambda field: field[0], rcm.TROCARS)
    pose, _ = rcm.ACTION_SPACES["rcm4"].decode(
        np.array([0.0, 0.0, 0.0, 0.03]), trocar, deployed.p_world_ref
    )
    seen = deploy.Observation(
        jax.tree.map(lambda x: np.stack([x, x]), pose), np.ones(2), state=np.zeros((2, 12))
    )
    command = deployed(jax.random.key(0), seen, trocar)
    assert command.pose.p.shape == (16, 3) and np.isfinite(command.pose.p).all()
    with pytest.raises(errors.UsageError, match="option: expected one of gain, time_dim"):
        deploy.load(path, ddim_steps=5)
    with pytest.raises(errors.UsageError, match="gain"):
        deploy.load(path, gain=11.0)


def settings(*argv):
    return run_settings.parse("run", [*argv, "--out", "x"], "")


def test_its_options_are_flags_and_stand_in_the_settings_of_a_run():
    found = settings("--preset", "smoke", "--policy.learner", "toy", "--policy.gain", "3")
    # common options begin at the preset's values
    assert found.policy.options == toy_learner.ToyConfig(gain=3.0, time_dim=32)
    values = config_json.as_json(found)
    assert values["policy"]["gain"] == 3.0 and values["policy"]["learner"] == "toy"
    assert config_json.from_dict(config.RunConfig, values) == found
    assert "policy.gain" in config_json.weight_settings(found)


@pytest.mark.parametrize(
    ("argv", "argument"),
    [
        (["--policy.learner", "toi"], "policy.learner"),
        (["--policy.learner", "toy", "--policy.gain", "11"], "policy.gain"),
        (["--policy.learner", "toy", "--policy.gain", "9", "--policy.horizon", "8"], "policy.gain"),
        (["--policy.learner", "toy", "--policy.ddim-steps", "5"], "FLAG"),
        (["--policy.gain", "2"], "FLAG"),
    ],
)
def test_a_mistake_in_its_options_is_named(argv, argument):
    with pytest.raises(errors.UsageError) as caught:
        settings("--preset", "smoke", *argv)
    assert caught.value.argument == argument


def test_the_nearest_flag_is_one_of_the_chosen_learner():
    assert "--policy.gain" in options.flags(dataclasses.replace(config.RunConfig(), policy=toy()))
    assert "--policy.ddim-steps" in options.flags(config.RunConfig)


def test_options_of_another_learner_are_refused():
    with pytest.raises(ValueError, match="options: expected ToyConfig, got DiffusionConfig"):
        dataclasses.replace(toy(), options=fakes.TINY.options)
    with pytest.raises(ValueError, match="gain"):
        config_json.from_dict(config.PolicyConfig, {"gain": 1.0})


def test_no_learner_calls_an_option_as_policies_call_a_setting():
    shared = {field.name for field in dataclasses.fields(config.PolicyConfig)}
    for name in learners.LEARNERS.names():
        options_of = dataclasses.fields(learners.LEARNERS.get(name).settings)
        assert shared.isdisjoint(field.name for field in options_of)


def test_settings_import_no_jax():
    program = """
import sys
from starjax.core import config, learners
from starjax.cli import run_settings
config.PolicyConfig()
run_settings.parse("run", ["--preset", "cpu", "--out", "x"], "")
assert not {"jax", "numpy", "mujoco"} & sys.modules.keys()
"""
    subprocess.run([sys.executable, "-c", program], check=True)
