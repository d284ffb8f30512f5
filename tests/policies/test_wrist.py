"""Methods that move a wrist: laws of their commands, with a stub's demonstrations."""

import functools

import fakes
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax import rcm
from starjax.core import config, errors
from starjax.core.methods import METHODS
from starjax.core.types import Pose
from starjax.data import normalizer, windows
from starjax.policies import execution, features
from starjax.policies import policy as policies

WRIST = rcm.LARGE_NEEDLE_DRIVER
TASK = fakes.task(slots=tuple(s._replace(tool="needle_driver") for s in fakes.TASK.slots))
TRAIN = config.TrainConfig(state_noise=0.0)
FRAMES = np.arange(80)
NAMES = [name for name, row in METHODS.items() if normalizer.has_wrist(row)]
# The others differ from one of these in the trocar alone, as a test below shows.
KINDS = ["dp_ee_wrist", "dp_ee_proj_wrist", "dp_rcm6", "stardiff_wrist", "stardiff_pose"]
ON_MANIFOLD = [name for name in NAMES if normalizer.keeps_to_manifold(METHODS[name])]


def jit(fn):
    # these programs run once: compiling them badly is fast
    return jax.jit(fn, compiler_options={"xla_backend_optimization_level": 0})


@functools.cache
def demonstrations() -> windows.Dataset:
    """The stub's demonstrations with bent wrists, each by a turn of its own."""
    dataset = fakes.dataset(0)
    axis = jax.random.normal(jax.random.key(5), (8, 3))
    turn = jax.vmap(rcm.rotation_from_axis_roll)(axis.at[:, 2].set(3.0), jnp.zeros(8))
    turn = turn[dataset.episode][:, None] @ np.diag([1.0, -1.0, -1.0])
    p_world_trocar = dataset.trocar.p_world_trocar[dataset.episode]

    def bent(part):
        pose = Pose(part.pose.R @ turn, part.pose.p)
        pose, angles, _ = rcm.through(WRIST, pose, p_world_trocar)
        return part._replace(pose=pose, wrist=angles)

    return dataset.replace(observation=bent(dataset.observation), command=bent(dataset.command))


@functools.cache
def made(name: str):
    """The policy of a method, its statistics, parameters and a batch."""
    policy = policies.make(METHODS[name], fakes.TINY, TASK, TRAIN)
    stats = normalizer.fit(METHODS[name], TASK, demonstrations(), FRAMES)
    batch = windows.gather(demonstrations(), jnp.array([3, 25, 70]), 2, 16)
    params = jax.tree.map(lambda x: x + 0.01, fakes.params(policy))
    return policy, stats, params, batch


def sampled(name: str, trocar: rcm.TrocarFrame | None = None):
    policy, stats, params, batch = made(name)
    keys = jax.random.split(jax.random.key(1), 3)
    return jit(policy.sample)(params, stats, keys, batch.observation, trocar or batch.trocar)


def shafts(command, p_world_trocar):
    return rcm.rcm_error(rcm.shaft_of(WRIST, command.pose, command.wrist), p_world_trocar[:, None])


@pytest.mark.parametrize("name", KINDS)
def test_demonstrated_actions_become_their_commands(name):
    _, stats, _, batch = made(name)
    row = METHODS[name]
    action = features.encode_commands(stats, row.action_space, batch, WRIST)
    command = execution.command(row, stats, action, batch.trocar, WRIST)
    assert np.abs(batch.command.wrist).max() > 0.3
    np.testing.assert_allclose(command.pose.p, batch.command.pose.p, atol=2e-6)
    np.testing.assert_allclose(command.pose.R, batch.command.pose.R, atol=5e-5)
    np.testing.assert_allclose(command.wrist, batch.command.wrist, atol=1e-4)
    # a broken action holds, with a straight wrist
    command = execution.command(row, stats, action.at[..., 1].set(jnp.nan), batch.trocar, WRIST)
    np.testing.assert_array_equal(command.gripper, -1.0)
    np.testing.assert_allclose(command.wrist, 0.0, atol=1e-4)
    assert shafts(command, batch.trocar.p_world_trocar).max() < 1e-6


@pytest.mark.parametrize("name", KINDS)
def test_shafts_pass_the_given_trocar_but_those_of_free_poses(name):
    told = demonstrations().trocar
    other = jax.tree.map(lambda x: x[jnp.array([5, 6, 7])], told)
    command = sampled(name, other)
    error = shafts(command, other.p_world_trocar)
    assert (np.max(error) < 1e-6) == (name in ON_MANIFOLD)
    limits = np.array([WRIST.pitch, WRIST.yaw]) + 1e-4
    assert (np.abs(command.wrist) <= limits).all() and np.isfinite(command.pose.R).all()


TELLING = ["stardiff_wrist", "stardiff_pose", "stardiff_pose_told", "dp_rcm6"]


@pytest.mark.parametrize("name", TELLING)
def test_tips_depend_on_the_trocar_only_if_it_conditions_the_model(name):
    *_, batch = made(name)
    first = batch.trocar.trocar
    moved = fakes.told(rcm.Trocar(first.radius[:, 0], first.polar[:, 0] - 0.1, first.azimuth[:, 0]))
    here, there = sampled(name), sampled(name, moved)
    apart = np.linalg.norm(here.pose.p - there.pose.p, axis=-1).max()
    assert (apart > 1e-5) if METHODS[name].sees_trocar else (apart < 2e-6)


def test_controls_differ_in_the_trocar_alone():
    for name, control in (
        ("stardiff_wrist", "stardiff_wrist_told"),
        ("stardiff_pose", "stardiff_pose_told"),
        ("dp_rcm6_untold", "dp_rcm6"),
    ):
        told, row = METHODS[control], METHODS[name]
        assert told.sees_trocar and not row.sees_trocar
        same = {"sees_trocar": False, "weights_of": "", "label": ""}
        assert told._replace(**same) == row._replace(**same)


def test_the_free_shaft_is_measured_and_not_that_of_the_trocar():
    _, stats, _, batch = made("dp_ee_wrist")
    observed = batch.observation._replace(wrist=batch.observation.wrist + 0.1)
    found = features.encode_proprioception(stats, "se3_wrist", observed, batch.trocar, WRIST)
    raw = stats.action.denormalize(found).reshape(3, 2, 1, 12)
    np.testing.assert_allclose(raw[..., 9:11], observed.wrist, atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_a_straight_tool_is_refused_in_one_line(name):
    with pytest.raises(errors.UsageError, match=r"tool: expected .*wrist.* got grasper$"):
        policies.make(METHODS[name], fakes.TINY, fakes.TASK, TRAIN)


@pytest.mark.parametrize("name", KINDS)
def test_every_parameter_learns(name):
    policy, stats, params, batch = made(name)

    def loss(params):
        return policy.loss(params, policy.prepare(stats, jax.random.key(0), batch))[0]

    value, gradient = jit(jax.value_and_grad(loss))(params)
    assert np.isfinite(value)
    for path, g in jax.tree_util.tree_leaves_with_path(gradient):
        assert np.isfinite(g).all() and np.abs(g).max() > 0, path
