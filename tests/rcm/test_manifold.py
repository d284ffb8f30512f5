"""The manifold: distance and depth (Eq. 3), its chart (Eq. 4), the projection onto it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import transform

from starjax import rcm

N = 4096


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture
def poses(rng):
    R = transform.Rotation.random(N, rng=rng).as_matrix().astype(np.float32)
    p = rng.uniform(-0.2, 0.2, (N, 3)).astype(np.float32)
    return rcm.Pose(R=R, p=p)


@pytest.fixture
def p_world_trocar(rng):
    return rng.uniform(-0.05, 0.05, (N, 3)).astype(np.float32)


def test_error_and_depth_equal_numpy(poses, p_world_trocar, oracle):
    error = jax.jit(rcm.rcm_error)(poses, p_world_trocar)
    expected = oracle.rcm_error(poses.R, poses.p, p_world_trocar)
    np.testing.assert_allclose(error, expected, atol=1e-7)
    depth = rcm.insertion_depth(poses, p_world_trocar)
    along = np.sum((poses.p - p_world_trocar).astype(np.float64) * poses.R[..., 2], axis=-1)
    np.testing.assert_allclose(depth, along, atol=1e-7)
    # Pythagoras: error and depth are the two parts of the offset.
    offset = np.linalg.norm(poses.p - p_world_trocar, axis=-1)
    np.testing.assert_allclose(np.hypot(error, depth), offset, atol=2e-7)


def test_a_known_offset():
    pose = rcm.Pose(R=np.diag([1.0, -1.0, -1.0]), p=np.array([0.003, -0.004, 0.0]))
    p_world_trocar = np.array([0.0, 0.0, 0.12])
    assert float(rcm.rcm_error(pose, p_world_trocar)) == pytest.approx(0.005, abs=1e-9)
    assert float(rcm.insertion_depth(pose, p_world_trocar)) == pytest.approx(0.12, abs=1e-8)


def test_chart_gives_the_axis_the_depth_and_the_trocar(rng, oracle, p_world_trocar):
    axis = oracle.unit(rng, N).astype(np.float32)
    roll = rng.uniform(-3, 3, N).astype(np.float32)
    depth = rng.uniform(rcm.MIN_DEPTH, rcm.MAX_DEPTH, N).astype(np.float32)
    pose = jax.jit(rcm.pose_on_manifold)(axis, roll, depth, p_world_trocar)
    assert oracle.rcm_error(pose.R, pose.p, p_world_trocar).max() < 1e-7
    np.testing.assert_allclose(pose.R[..., 2], axis, atol=2e-6)
    np.testing.assert_allclose(rcm.insertion_depth(pose, p_world_trocar), depth, atol=2e-7)


@pytest.mark.parametrize(
    ("depth", "clipped"), [(-1.0, 0.005), (0.0, 0.005), (0.1, 0.1), (9.0, 0.4)]
)
def test_depth_is_clipped(depth, clipped):
    pose = rcm.pose_on_manifold(np.array([0.0, 0.6, -0.8]), 0.3, depth, np.zeros(3))
    assert float(rcm.insertion_depth(pose, np.zeros(3))) == pytest.approx(clipped, abs=1e-7)


def test_projection_keeps_the_tip_and_meets_the_trocar(poses, p_world_trocar, oracle):
    projected = jax.jit(rcm.project)(poses, p_world_trocar)
    np.testing.assert_array_equal(projected.p, poses.p)
    oracle.check_rotations(projected.R)
    assert oracle.rcm_error(projected.R, projected.p, p_world_trocar).max() < 1e-6
    assert np.asarray(rcm.insertion_depth(projected, p_world_trocar)).min() > 0


def test_projection_turns_as_little_as_possible(poses, p_world_trocar):
    projected = jax.jit(rcm.project)(poses, p_world_trocar)
    turn = transform.Rotation.from_matrix(projected.R @ poses.R.swapaxes(-1, -2)).magnitude()
    axis, target = poses.R[..., 2].astype(np.float64), poses.p - p_world_trocar.astype(np.float64)
    between = np.arctan2(
        np.linalg.norm(np.cross(axis, target), axis=-1), np.sum(axis * target, axis=-1)
    )
    np.testing.assert_allclose(turn, between, atol=1e-5)


def test_projection_leaves_the_manifold_alone(rng, oracle, p_world_trocar):
    axis, roll = oracle.unit(rng, N), rng.uniform(-3, 3, N)
    pose = rcm.pose_on_manifold(axis, roll, np.full(N, 0.1), p_world_trocar)
    np.testing.assert_allclose(rcm.project(pose, p_world_trocar).R, pose.R, atol=3e-6)


def test_projection_where_it_is_singular(oracle):
    """Tip at the trocar, and tool pointing exactly away from where it should."""
    R = np.diag([1.0, -1.0, -1.0]).astype(np.float32)
    same = jax.jit(rcm.project)(rcm.Pose(R=R, p=np.ones(3, np.float32)), np.ones(3, np.float32))
    np.testing.assert_allclose(same.R, R, atol=1e-7)
    above = np.array([0.0, 0.0, 0.1], np.float32)
    flipped = jax.jit(rcm.project)(rcm.Pose(R=R, p=above), np.zeros(3, np.float32))
    oracle.check_rotations(flipped.R)
    np.testing.assert_allclose(flipped.R[:, 2], [0, 0, 1], atol=1e-6)


def test_derivatives_are_finite_everywhere():
    p = [(0, 0, 0), (0, 0, -0.1), (0, 0, 0.1), (1e-45, 0, 0.1), (1e-6, 1e-7, 0.1), (1e30, 0, 0)]
    R = jnp.diag(jnp.array([1.0, -1.0, -1.0]))

    def total(R, p, p_world_trocar):
        pose = rcm.Pose(R=R, p=p)
        projected = rcm.project(pose, p_world_trocar)
        numbers = (projected.R, rcm.rcm_error(pose, p_world_trocar), projected.p)
        return sum(jnp.sum(value) for value in numbers) + rcm.insertion_depth(pose, p_world_trocar)

    gradient = jax.jit(jax.vmap(jax.grad(total, (0, 1, 2)), (None, 0, None)))
    for part in gradient(R, jnp.array(p, jnp.float32), jnp.zeros(3)):
        assert np.isfinite(part).all()


def test_a_non_finite_pose_shows_as_one():
    pose = rcm.Pose(R=np.eye(3), p=np.array([0.0, np.nan, 0.0]))
    assert np.isnan(rcm.rcm_error(pose, np.zeros(3)))
    sound, here = rcm.Pose(R=np.eye(3), p=np.zeros(3)), np.zeros(3)
    far = sound._replace(p=np.array([np.inf, 0.0, 0.0]))
    for bad, port in ((pose, here), (far, here), (sound, here * np.nan)):
        assert all(np.isnan(part).all() for part in rcm.project(bad, port))


def test_bad_shapes_are_named():
    with pytest.raises(ValueError, match=r"pose.R: expected .*3, 3\], got \[3\]"):
        rcm.rcm_error(rcm.Pose(R=np.zeros(3), p=np.zeros(3)), np.zeros(3))
    with pytest.raises(ValueError, match=r"p_world_trocar: expected .*3\], got \[4\]"):
        jax.jit(rcm.project)(rcm.Pose(R=np.eye(3), p=np.zeros(3)), np.zeros(4))


def test_an_error_of_a_ten_thousandth_of_a_millimetre_is_one():
    pose = rcm.Pose(R=np.diag([1.0, -1.0, -1.0]), p=np.array([1e-7, 0.0, -0.1]))
    assert float(rcm.rcm_error(pose, np.zeros(3))) == pytest.approx(1e-7, rel=1e-3)


def test_a_tilted_tool_whose_tip_is_at_the_trocar_stays_as_it_is():
    tilted = rcm.rotation_from_axis_roll(np.array([0.3, -0.2, -0.9], np.float32), 0.4)
    projected = rcm.project(rcm.Pose(R=tilted, p=np.ones(3)), np.ones(3))
    np.testing.assert_allclose(projected.R, tilted, atol=1e-6)


def test_a_rotation_that_is_not_finite_is_not_projected():
    pose = rcm.Pose(R=np.full((3, 3), np.nan), p=np.ones(3))
    assert all(np.isnan(part).all() for part in rcm.project(pose, np.zeros(3)))
