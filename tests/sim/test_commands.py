"""The environment under commands that no RCM method gives: free poses, and none at all."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax import rcm
from starjax.core.types import Command, Pose

LANES = 12
NOMINAL = rcm.Trocar(*(np.full(LANES, x, np.float32) for x in (0.0, np.pi / 2, 0.0)))
DOWN = np.diag([1.0, -1.0, -1.0]).astype(np.float32)
TIP = np.array([0.0, 0.0, 0.05], np.float32)
STEPS = 75


@pytest.fixture(scope="module")
def follow(reset, step):
    """`poses of the lanes -> states` of 2.5 s under them, `[T, N]`, from above the board."""

    begun = reset(0, NOMINAL)
    for _ in range(40):
        begun = step(begun, constant([Pose(DOWN, TIP)] * LANES))

    def run(poses):
        state, states = begun, []
        for _ in range(STEPS):
            state = step(state, constant(poses))
            states.append(state)
        return jax.tree.map(lambda *leaves: np.stack(leaves), *states)

    return run


def constant(poses):
    poses = jax.tree.map(lambda *leaves: jnp.stack(leaves)[:, None], *poses)
    return Command(poses, jnp.ones((LANES, 1)))


def tilted(degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]], np.float32) @ DOWN


def through(*tip):
    pose, _ = rcm.ACTION_SPACES["rcm4"].decode(
        np.array([0.0, *tip], np.float32), rcm.Trocar(0.0, np.pi / 2, 0.0), [0.0, 0.0, 0.15]
    )
    return pose


@pytest.mark.slow
def test_what_is_asked_of_the_arm_is_approached_and_not_leapt_at(follow):
    tilts = [2, 3, 5, 10, 20, -5]
    # tools that lie at 45 degrees, near the port and far from it
    leaning = [through(0.05, 0, 0.1), through(0, 0.03, 0.12), through(0, 0.05, 0.1)]
    retracted = [Pose(DOWN, np.array([0, 0, z], np.float32)) for z in (0.13, 0.15, 0.2)]
    after = follow([*(Pose(tilted(a), TIP) for a in tilts), *leaning, *retracted])
    assert not after.invalid.any()
    wanted = 0.1 * np.abs(np.sin(np.radians(tilts)))  # m, as the tip is 0.1 m below the port
    error = after.rcm_error_within[:, : len(tilts), 0]
    assert (error.max(axis=0) < wanted + 1e-3).all()
    np.testing.assert_allclose(error[-1], wanted, atol=3e-4)
    off = np.linalg.norm(after.pose.p[:, : len(tilts), 0] - TIP, axis=-1)
    assert off.max() < 2e-3
    on_manifold = after.rcm_error[:, len(tilts) :, 0]
    assert on_manifold.max() < 4e-3 and on_manifold[-1].max() < 1e-4
    # a tool that is drawn out of the port stays as it points
    axis = after.pose.R[:, -3:, 0, :, 2]
    assert (axis[..., 2] < -0.999).all()
    np.testing.assert_allclose(after.pose.p[-1, -3:, 0, 2], [0.13, 0.15, 0.2], atol=1e-3)


@pytest.mark.slow
def test_a_tool_near_the_port_comes_to_rest(follow):
    depths = [rcm.MIN_DEPTH, 0.0055, 0.008, 0.012, 0.02, 0.03]
    port = np.array([0.0, 0.0, 0.15], np.float32)
    axes = np.array([[0.06, 0.03, -1.0], [-0.03, 0.08, -1.0]], np.float32)
    after = follow([rcm.pose_on_manifold(a, 0.0, d, port) for d in depths for a in axes])
    assert not after.invalid.any()
    assert after.rcm_error.max() < 0.01 and after.rcm_error[-15:].max() < 5e-5


@pytest.mark.slow
def test_what_is_no_command_holds_the_arm_and_a_good_one_is_followed_again(reset, step):
    state = reset(1)
    not_finite = np.full((3, 3), np.nan, np.float32)
    mirrored = np.diag([1.0, 1.0, -1.0]).astype(np.float32)
    bad = [not_finite, np.zeros((3, 3), np.float32), 1.1 * DOWN, mirrored]
    held = np.arange(LANES) <= len(bad)
    R = np.array(state.pose.R)
    R[: len(bad), 0] = bad
    close = np.where(np.arange(LANES) == len(bad), np.nan, -1.0)[:, None].astype(np.float32)
    after = step(state, Command(Pose(jnp.asarray(R), state.pose.p), jnp.asarray(close)))
    assert not after.invalid.any()
    np.testing.assert_array_equal(np.isinf(after.ik_error[:, 0]), held)
    np.testing.assert_array_equal(after.q_target[0][held], state.q_target[0][held])
    np.testing.assert_array_equal(after.gripper_target[:, 0], np.where(held, 1.0, -1.0))
    np.testing.assert_array_equal(after.velocity[held], 0.0)
    off = np.linalg.norm(after.pose.p - state.pose.p, axis=-1)
    assert off.max() < 1e-4
    back = state.pose.p - 3e-3 * state.pose.R[..., 2]
    for _ in range(12):
        after = step(after, Command(Pose(state.pose.R, back), jnp.ones((LANES, 1))))
    np.testing.assert_allclose(after.pose.p, back, atol=3e-4)


def test_a_port_that_is_not_finite_ends_the_episode_at_once(reset):
    radius = np.where(np.arange(LANES) == 3, np.nan, rcm.TROCARS.radius).astype(np.float32)
    state = reset(0, rcm.TROCARS._replace(radius=radius))
    np.testing.assert_array_equal(state.invalid, np.isnan(radius))
    np.testing.assert_array_equal(state.done, np.isnan(radius))
