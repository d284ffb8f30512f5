"""Actions, rewards and observations of one episode, without simulating much."""

import types

import jax
import jax.numpy as jnp
import mistakes
import numpy as np
import pytest

from starjax import rcm
from starjax.core.types import Command, Pose
from starjax.envs import mdp, ranges, settings
from starjax.sim import registries

STEPS = 40


@pytest.fixture(scope="module")
def start():
    made = mdp.make(settings.make(task="reach", trocar="unseen", max_episode_steps=STEPS))
    return jax.jit(made.reset)(jax.random.key(1))


def frame(task):
    places = np.array([slot.p_world_ref for slot in task.slots], np.float32)
    zeros = np.array([slot.roll_zero for slot in task.slots], np.float32)
    first = rcm.Trocar(*(field[-1] for field in task.trocars))
    return rcm.trocar_frame(first, places, zeros)


@pytest.mark.parametrize("task", ["peg_transfer", "peg_transfer_bimanual"])
@pytest.mark.parametrize(
    "space", [name for name, s in rcm.ACTION_SPACES.items() if s.for_wrist is None]
)
def test_the_workspace_lies_within_the_bounds_of_actions(task, space):
    """Poses whose tip and roll are the workspace's, through a new trocar."""
    task = registries.tasks.get(task)
    low, high = ranges.actions(task, rcm.ACTION_SPACES[space])
    assert low.shape == high.shape == (task.arms, rcm.ACTION_SPACES[space].dim)
    assert (high - low > 0.05).all() and np.isfinite(high - low).all()
    work = registries.workspaces.get(task.slots[0].workspace)
    drawn = np.random.default_rng(0).uniform(size=(200, task.arms, 4))
    bottom, top = (np.array([r, *x]) for r, x in zip(work.rolls, (work.low, work.high)))
    pose, _ = rcm.ACTION_SPACES["rcm4"].decode(bottom + (top - bottom) * drawn, frame(task))
    action = rcm.ACTION_SPACES[space].encode(pose, frame(task))
    within = (action > low - 0.01 * (high - low)) & (action < high + 0.01 * (high - low))
    assert within.all()


@pytest.mark.parametrize("space", ["se3", "rcm1", "rcm2", "rcm3", "rcm4"])
@pytest.mark.parametrize("control", settings.CONTROLS)
def test_an_action_says_the_pose_that_it_is_made_from(start, space, control):
    made = mdp.make(settings.make(task="reach", action_space=space, control=control))
    near = start.pose.p + jnp.array([0.002, -0.001, -0.014])
    pose, _ = rcm.ACTION_SPACES["rcm4"].decode(
        jnp.concatenate([jnp.array([[0.1]]), near], -1), start.measured_trocar
    )
    command = Command(pose, jnp.array([0.5]))
    data = start.replace(pose=Pose(pose.R, near + 0.001))
    again = made.decode(data, made.encode(data, command))
    np.testing.assert_allclose(again.pose.R, pose.R, atol=2e-4)
    np.testing.assert_allclose(again.pose.p, pose.p, atol=2e-6)
    np.testing.assert_allclose(again.gripper, 0.5, atol=1e-6)


@pytest.mark.parametrize("space", ["rcm1", "rcm4"])
def test_whatever_the_action_the_shaft_goes_through_the_trocar(start, space):
    made = mdp.make(settings.make(task="reach", action_space=space))
    actions = jax.random.uniform(jax.random.key(2), (500, made.action_size), minval=-3, maxval=3)
    command = jax.vmap(made.decode, (None, 0))(start, actions)
    error = rcm.rcm_error(command.pose, start.trocar.p_world_trocar)
    assert float(error.max()) < 1e-6


@pytest.mark.parametrize(("space", "control"), [("rcm6", "relative"), ("se3_through", "absolute")])
def test_actions_of_a_wrist_bend_it_and_keep_its_shaft_in_the_trocar(space, control):
    made = mdp.make(
        settings.make(task="reach", tools="needle_driver", action_space=space, control=control)
    )
    wrist, trocar = rcm.LARGE_NEEDLE_DRIVER, frame(made.env.task)
    bent = jnp.array([[0.2, 0.6, -0.5, 0.01, 0.0, 0.02]])
    pose, _ = rcm.rcm6(wrist).decode(bent, trocar)
    state = types.SimpleNamespace(pose=Pose(pose.R, pose.p + 0.002), measured_trocar=trocar)
    command = Command(pose, jnp.array([0.5]))
    again = made.decode(state, made.encode(state, command))
    np.testing.assert_allclose(again.pose.p, pose.p, atol=3e-6)
    np.testing.assert_allclose(again.pose.R, pose.R, atol=3e-4)
    np.testing.assert_allclose(again.wrist, bent[:, 1:3], atol=3e-4)

    actions = jax.random.uniform(jax.random.key(2), (200, made.action_size), minval=-3, maxval=3)
    drawn = jax.vmap(made.decode, (None, 0))(state, actions)
    shaft = rcm.shaft_of(wrist, drawn.pose, drawn.wrist)
    assert float(rcm.rcm_error(shaft, trocar.p_world_trocar).max()) < 1e-6
    assert float(jnp.abs(drawn.wrist).max()) > 0.5


def test_a_straight_tool_has_no_actions_of_a_wrist():
    with mistakes.of("tools", "grasper"):
        mdp.make(settings.make(task="reach", action_space="rcm6"))


def outcome(start, reward="dense", **changed):
    given = settings.make(task="reach", reward=reward, max_episode_steps=STEPS)
    after = start.replace(step=start.step + 1, **changed)
    return mdp.make(given).judge(start, after)


def test_rewards(start):
    yes = jnp.ones((), bool)
    begun = start.replace(reward=jnp.float32(0.25))
    assert float(outcome(begun).reward) == -0.75
    won = begun.replace(reward=jnp.float32(1.0))
    found = outcome(won, success=yes)
    assert float(found.reward) == 0.0 and found.terminated and not found.truncated
    lost = outcome(begun, lost=yes)
    assert float(lost.reward) == -0.75 - (STEPS - 1) and lost.terminated
    assert outcome(begun, invalid=yes).terminated
    late = begun.replace(step=jnp.int32(STEPS - 1))
    assert outcome(late).truncated and not outcome(late).terminated
    assert float(outcome(begun, "sparse").reward) == 0.0
    assert float(outcome(begun, "sparse", success=yes).reward) == 1.0
    over = begun.replace(step=jnp.int32(STEPS))
    assert float(outcome(over).reward) == 0.0
