"""An arm that holds a wrist: its shaft keeps to the trocar, for any motion of the tip."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax import rcm
from starjax.core.types import Command, Pose
from starjax.sim import collision, control, dynamics, physics, wrist_motion
from starjax.sim import env as envs
from starjax.sim.task import CONTROL_HZ, Capsules

WRIST = rcm.LARGE_NEEDLE_DRIVER
PERIOD = 1.0 / CONTROL_HZ
TROCAR = np.array([0.02, -0.01, 0.15], np.float32)
DOWN = np.diag([1.0, -1.0, -1.0]).astype(np.float32)


def bent(pitch, yaw, p=(0.0, 0.0, 0.02)):
    """A tip of these angles through the trocar, as an action of `rcm6` has it."""
    frame = rcm.trocar_frame(rcm.trocar_from_position(TROCAR, TROCAR - 0.01), TROCAR - 0.01)
    action = jnp.array([0.3, pitch, yaw, *p], jnp.float32)
    return rcm.rcm6(WRIST).decode(action, frame)[0]


@pytest.mark.parametrize("angles", [(0.0, 0.0), (0.9, -0.7), (-1.3, 0.4)])
def test_the_arm_carries_the_shaft_and_the_tip_stays(angles):
    tip = bent(*angles)
    shaft, found = wrist_motion.carried(WRIST, tip, TROCAR)
    np.testing.assert_allclose(found, angles, atol=1e-5)
    assert rcm.rcm_error(shaft, TROCAR) < 1e-6
    again = rcm.tip_of(WRIST, shaft, found)
    np.testing.assert_allclose(again.p, tip.p, atol=1e-6)
    np.testing.assert_allclose(again.R, tip.R, atol=1e-5)


def test_a_wrist_in_its_cannula_is_straight():
    inside, outside = (wrist_motion.limits_at(WRIST, jnp.float32(x)) for x in (0.0, 0.05))
    np.testing.assert_allclose(inside[2:], np.deg2rad(15.0), rtol=1e-6)
    np.testing.assert_allclose(outside[2:], WRIST[2:], rtol=1e-6)
    near = bent(1.0, 0.5, p=TROCAR - np.array([0.0, 0.0, 0.026], np.float32))
    _, angles = wrist_motion.carried(WRIST, near, TROCAR)
    assert np.abs(angles).max() < 0.9


def test_tip_rotation_and_shaft_arrive_together_within_their_limits():
    start, goal = bent(0.0, 0.0), bent(1.0, -0.8, p=(0.03, 0.02, 0.03))
    there = jnp.asarray(TROCAR) + jnp.array([1e-3, 0.0, 0.0])
    step = jax.jit(functools.partial(wrist_motion.toward, period=PERIOD))
    tip, point, velocity = start, jnp.asarray(TROCAR), jnp.zeros(wrist_motion.VELOCITY)
    for _ in range(60):
        before = velocity
        tip, point, velocity = step(tip, point, velocity, goal, there)
        assert jnp.linalg.norm(velocity[:3]) < control.MAX_SPEED + 1e-6
        assert jnp.linalg.norm(velocity[3:6]) < control.MAX_SPIN + 1e-5
        change = jnp.linalg.norm(velocity[:3] - before[:3])
        assert change < control.MAX_ACCELERATION * PERIOD + 1e-5
        if (tip.p == goal.p).all():
            break
        way = [jnp.linalg.norm(a - b) for a, b in ((tip.p, goal.p), (start.p, goal.p))]
        spin = [jnp.linalg.norm(a - b) for a, b in ((tip.R, goal.R), (start.R, goal.R))]
        assert abs(way[0] / way[1] - spin[0] / spin[1]) < 0.15
    np.testing.assert_array_equal(tip.R, goal.R)
    np.testing.assert_allclose(point, there, atol=1e-6)


class Episode:
    """The task `reach` with the manipulator and its needle driver, and servos that never lag."""

    def __init__(self):
        self.env = envs.make("reach", ["psm"], ["needle_driver"], observation="state")
        scene = self.env.scene

        def advance(scene, state, q, dq, velocity, gripper, p_world_trocar, *rest):
            qpos = state.qpos.at[scene.arms[0].q].set(q[0] + dq[0])
            after = state.replace(qpos=qpos)
            contacts = physics.no_contacts(scene)
            touch = jnp.zeros(1, bool)
            return after, physics.StepResult(touch, contacts, qpos[None], jnp.zeros(()))

        self.step = jax.jit(functools.partial(dynamics.step, scene, advance=advance))
        trocar = jax.tree.map(lambda x: jnp.asarray(x[3:4], jnp.float32), rcm.TROCARS)
        self.first = jax.jit(self.env.reset)(jax.random.key(0), envs.EnvParams(trocar))


@pytest.fixture(scope="module")
def episode():
    return Episode()


def test_executed_tips_and_shafts_are_those_of_the_action(episode):
    state = episode.first
    assert state.wrist.shape == (1, 2) and not state.wrist.any()
    space = rcm.rcm6(WRIST)
    for t in range(45):
        turn = 0.05 * t
        roll, angles = 0.4 * np.sin(turn), [0.9 * np.sin(turn), 0.7 * np.sin(0.7 * turn)]
        action = np.float32([[roll, *angles, 0.01 * np.sin(turn), 0.01, 0.03]])
        pose, valid = space.decode(action, state.trocar)
        command = Command(pose, jnp.ones(1), jnp.float32([angles]))
        state = episode.step(state, command)
        if t > 15:  # the sudden start is over
            assert valid.all() and state.ik_error.max() < 1e-5
            np.testing.assert_allclose(state.pose.p, pose.p, atol=1e-5)
            np.testing.assert_allclose(state.pose.R, pose.R, atol=1e-4)
            np.testing.assert_allclose(state.wrist[0], angles, atol=1e-4)
        assert state.rcm_error_within.max() < 1e-5
    assert np.abs(state.wrist).max() > 0.1
    seen = episode.env.observe(state)
    np.testing.assert_array_equal(seen.wrist, state.wrist)
    straight, _ = rcm.ACTION_SPACES["rcm4"].decode(action[:, [0, 3, 4, 5]], state.trocar)
    for _ in range(20):
        state = episode.step(state, Command(straight, jnp.ones(1)))
    assert np.abs(state.wrist).max() < 1e-4  # a command without angles straightens it


def test_the_part_before_the_jaws_may_touch_nothing(episode):
    arms, p = episode.env.scene.arms, jnp.array([[0.0, 0.0, 0.03]])
    # The shaft lies along x, the jaws point down: only the palm is at x = 0.
    lying = jnp.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])[None]
    tip = Pose(jnp.asarray(DOWN)[None], p)
    yaw_axis = p + jnp.array([[0.0, 0.0, WRIST.jaws]])
    shaft = Pose(lying, yaw_axis - jnp.array([[WRIST.clevis, 0.0, 0.0]]))
    nowhere = jnp.array([[0.0, 0.0, 0.0]]) - 9.0
    joints = [jnp.full((4, 3), 0.5)]

    def hit(x, z):
        at = jnp.array([[x, 0.0, z]])
        rod = Capsules(at - jnp.array([0.0, 0.05, 0.0]), at + jnp.array([0.0, 0.05, 0.0]), 1e-3)
        return bool(collision.detect(arms, tip, joints, nowhere, rod, 0.0, shaft))

    assert not hit(0.0, 0.03 + WRIST.jaws + 0.006)
    assert hit(0.0, 0.03 + WRIST.jaws + 0.0039)  # radii of 4.5 mm, less the allowance
    assert hit(-WRIST.clevis, 0.03 + WRIST.jaws)
    assert hit(-WRIST.clevis - 0.02, 0.03 + WRIST.jaws)  # the shaft itself
    low = Pose(tip.R, p - 0.031)
    assert bool(
        collision.detect(
            arms, low, joints, nowhere, Capsules(nowhere, nowhere, jnp.zeros(1)), 0.0, shaft
        )
    )
