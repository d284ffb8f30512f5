"""A stranger's action space of each kind: data, executor, agent, robot, environment."""

import functools
import importlib
import pathlib
import sys

import fakes
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax import deploy, rcm
from starjax.core import errors
from starjax.core.methods import METHODS
from starjax.data import normalizer, windows
from starjax.deploy import approach
from starjax.envs import mdp, settings
from starjax.policies import execution, features, in_env, policy_file
from starjax.policies import policy as policies
from starjax.sim import registries, wrists
from starjax.sim.rollouts import ensemble
from starjax.testing import action_spaces, base

SITE = pathlib.Path(__file__).parent / "site"
WRISTED = ("toy_wrist", "toy_wrist_relative")
FREE = ("toy_free", "toy_wrist_free")
NAMES = ("toy_relative", "toy_absolute", *WRISTED, *FREE)
DRIVER = fakes.SCENE._replace(task="fake", tools=("needle_driver",))
FRAMES = np.arange(80)


@pytest.fixture(autouse=True)
def installed(monkeypatch):
    monkeypatch.syspath_prepend(SITE)
    for name in [name for name in sys.modules if name.startswith("starjax_toy")]:
        monkeypatch.delitem(sys.modules, name)
    rcm.action_space.cache_clear()
    importlib.invalidate_caches()


def scene(name):
    return DRIVER if "wrist" in name else fakes.SCENE._replace(task="fake")


def held(name):
    return wrists.holding(fakes.TASK, scene(name))


def wrist_of(name):
    return normalizer.wrist_of(METHODS[name], held(name))


@functools.cache
def fitted(name):
    return normalizer.fit(METHODS[name], held(name), fakes.dataset(0), FRAMES)


def shafts(name, pose, angles):
    return pose if angles is None else rcm.shaft_of(wrist_of(name), pose, angles)


@pytest.mark.parametrize("name", NAMES)
def test_no_check_of_its_author_fails(name):
    found = {check.subject: check.status for check in action_spaces.check(name, 1)}
    assert set(found.values()) == {base.OK}
    assert ("manifold" in found) == (name not in FREE)


@pytest.mark.parametrize("name", NAMES)
def test_samples_of_a_relative_space_alone_reach_further_than_demonstrations(name):
    stats, dataset = fitted(name).action, fakes.dataset(0)
    assert normalizer.shapes(METHODS[name], held(name), False).action.low.shape == stats.low.shape
    assert (stats.reach is not None) == name.endswith("relative")
    if stats.reach is None:
        return
    trocars = rcm.sample_trocar(jax.random.key(3), (50,))
    frame = rcm.trocar_frame(trocars, fakes.P_WORLD_REF)
    frame = jax.tree.map(lambda x: jnp.asarray(x)[:, None], frame)
    p = dataset.command.pose.p[FRAMES, 0] - frame.p_world_trocar
    _, high = jax.vmap(stats.denormalize)(stats.reach)
    assert (p.max((0, 1)) <= high[:3] + 1e-3).all() and (np.asarray(stats.reach[1, 3:]) == 1).all()


@pytest.mark.parametrize("name", NAMES)
def test_commands_keep_to_the_trocar_unless_the_space_is_free(name):
    row, stats, wrist = METHODS[name], fitted(name), wrist_of(name)
    trocar = jax.tree.map(lambda x: x[:3], fakes.dataset(0).trocar)
    size = stats.action.low.shape[0]
    drawn = jax.random.uniform(jax.random.key(0), (3, 16, size), minval=-1.0)
    command = execution.command(row, stats, drawn, trocar, wrist)
    assert (command.wrist is not None) == ("wrist" in name)
    shaft = shafts(name, command.pose, command.wrist)
    miss = float(rcm.rcm_error(shaft, features.per_step(trocar).p_world_trocar).max())
    assert miss > 1e-3 if name in FREE else miss < 1e-6


def test_a_free_wrists_angles_are_commanded_as_measured():
    command = jax.tree.map(lambda x: x[FRAMES], fakes.dataset(0).command)
    angles = jnp.full((*command.gripper.shape, 2), 0.4)
    trocar = jax.tree.map(lambda x: x[fakes.dataset(0).episode[FRAMES]], fakes.dataset(0).trocar)
    for name in ("toy_wrist", "toy_wrist_free"):
        space = rcm.action_space(name, wrist_of(name))
        given = normalizer.encode(
            name, command.pose, command.gripper, trocar, wrist_of(name), angles
        )
        assert (given[:, space.slices["wrist"]] == 0.4).all() == (name in FREE)


@pytest.mark.parametrize("name", NAMES)
def test_averaged_plans_are_brought_back_to_the_trocar_unless_free(name, monkeypatch):
    averaged = []
    monkeypatch.setattr(ensemble, "from_policy", lambda *arguments: averaged.append(arguments[2]))
    policy = policies.make(METHODS[name], fakes.TINY, held(name))
    in_env.batch_agent(name, policy, fakes.TINY, True, wrist_of(name))
    in_env.batch_agent.cache_clear()
    assert averaged == [name not in FREE]


@pytest.mark.parametrize("name", NAMES)
def test_a_robot_is_told_if_the_shaft_keeps_to_the_trocar(name, tmp_path, monkeypatch):
    monkeypatch.setattr(registries, "tasks", registries.Registry("task", {"fake": "fakes:TASK"}))
    policy = policies.make(METHODS[name], fakes.TINY, held(name))
    policy_file.save(
        tmp_path / "policy.safetensors",
        fakes.trained(
            method=name,
            params=fakes.params(policy),
            normalizer=fitted(name),
            scene=scene(name),
        ),
    )
    if name == "toy_wrist_free":
        with pytest.raises(errors.UsageError) as caught:
            deploy.load(tmp_path / "policy.safetensors")
        assert caught.value.argument == "method"
        return
    spec = deploy.load(tmp_path / "policy.safetensors").input_spec
    assert spec.keeps_to_manifold == (name not in FREE)
    assert bool(spec.wrist) == (name in WRISTED)


def test_a_tool_above_its_demonstrations_approaches_in_coordinates_of_any_name():
    name = "toy_relative"
    stats, trocar = fitted(name), jax.tree.map(lambda x: x[:1], fakes.dataset(0).trocar)
    pose = jax.tree.map(lambda x: x[:1], fakes.dataset(0).command.pose)
    at = rcm.pose_at_depth(pose.R, jnp.array([[0.02]]), trocar.p_world_trocar)
    assert not approach._is_outside(name, stats, pose, trocar).any()
    assert approach._is_outside(name, stats, at, trocar).all()


@pytest.mark.parametrize("name", NAMES)
def test_an_environment_takes_its_actions(name):
    tools = "needle_driver" if "wrist" in name else "grasper"
    chosen = settings.make(task="reach", tools=tools, action_space=name)
    if name == "toy_wrist_free":
        with pytest.raises(errors.UsageError) as caught:
            mdp.make(chosen)
        assert caught.value.argument == "action_space"
        return
    made = mdp.make(chosen)
    assert made.action_size == rcm.ACTION_SPACES[name].dim + 1
    if name in WRISTED:
        with pytest.raises(errors.UsageError) as caught:
            mdp.make(settings.make(task="reach", tools="grasper", action_space=name))
        assert caught.value.argument == "tools"


@pytest.mark.parametrize("name", ["toy_absolute", "toy_wrist"])
def test_a_hierarchys_network_predicts_the_turns_of_the_space(name):
    policy = policies.make(METHODS[name], fakes.TINY, held(name))
    batch = windows.gather(fakes.dataset(0), jnp.array([3]), 2, 16)
    prepared = jax.eval_shape(policy.prepare, fitted(name), jax.random.key(0), batch)
    assert prepared.lesson.target.shape[-1] == (3 if "wrist" in name else 1)
    assert "roll_loss" in policy.metrics
    with pytest.raises(ValueError, match="turns and position"):
        policies.make(METHODS["toy_relative"]._replace(hierarchical=True), fakes.TINY, fakes.TASK)
