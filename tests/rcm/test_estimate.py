"""The trocar of a moving tool: against numpy, with noise, wrong poses, motions that say nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import transform

from starjax import rcm

TRUE = np.array([0.03, -0.02, 0.14], np.float32)


def moved(rng, tips, noise=0.0, trocar=TRUE):
    """Poses through the trocar at tips `[..., 3]`, with any roll; the axis `noise` m off it."""
    axis = tips - trocar
    R = rcm.rotation_from_axis_roll(axis, rng.uniform(-3, 3, tips.shape[:-1]))
    off = rng.normal(size=tips.shape) * noise
    return rcm.Pose(np.array(R), (tips + off).astype(np.float32))


def over_the_board(rng, shape=(300,), width=0.04):
    return (rng.uniform(-width, width, (*shape, 3)) * [1, 1, 0.3] + [0, 0, 0.02]).astype(np.float32)


def least_squares(pose):
    """The textbook's normal equations in double precision."""
    a, p = np.asarray(pose.R, np.float64)[..., 2], np.asarray(pose.p, np.float64)
    P = np.eye(3) - a[:, :, None] * a[:, None, :]
    return np.linalg.solve(P.sum(0), np.einsum("tij,tj->i", P, p))


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture(scope="module")
def estimate():
    return jax.jit(rcm.trocar_from_poses)


def test_an_exact_motion_gives_the_trocar_to_float32(rng, estimate):
    trocars = rng.uniform(-0.05, 0.05, (40, 1, 3)).astype(np.float32) + np.float32([0, 0, 0.15])
    found = estimate(moved(rng, over_the_board(rng, (40, 300)), trocar=trocars))
    np.testing.assert_allclose(found.p_world_trocar, trocars[:, 0], atol=2e-6)
    assert found.is_determined.all() and (np.asarray(found.residual) < 3e-7).all()
    np.testing.assert_allclose(found.weight, 1.0, atol=0.05)


def test_noise_gives_the_least_squares_and_its_covariance_is_what_is_seen(rng, estimate):
    tips, noise = over_the_board(rng, (400, 200)), 2e-4
    pose = moved(rng, tips, noise)
    found = estimate(pose)
    errors = np.asarray(found.p_world_trocar) - TRUE
    expected = [least_squares(rcm.Pose(R, p)) for R, p in zip(pose.R, pose.p)]
    assert np.abs(found.p_world_trocar - np.array(expected)).max() < 0.5 * np.abs(errors).max()
    np.testing.assert_allclose(found.residual, noise * 2**0.5, rtol=0.2)
    whitened = np.linalg.solve(np.linalg.cholesky(found.covariance), errors[..., None])[..., 0]
    np.testing.assert_allclose(np.cov(whitened.T), np.eye(3), atol=0.35)


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_wrong_poses_do_not_matter(rng, estimate, share):
    pose = moved(rng, over_the_board(rng), 1e-5)
    wrong = rng.permutation(300)[: int(300 * share)]
    pose.R[wrong] = transform.Rotation.random(len(wrong), rng=rng).as_matrix()
    pose.p[wrong] += rng.normal(size=(len(wrong), 3), scale=0.1).astype(np.float32)
    found = estimate(pose)
    np.testing.assert_allclose(found.p_world_trocar, TRUE, atol=5e-5)
    assert np.asarray(found.weight)[wrong].mean() < 0.02
    assert np.linalg.norm(least_squares(pose) - TRUE) > 1e-3  # the plain one is led astray


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e30, -1e4])
def test_values_that_are_none_are_left_out(rng, estimate, bad):
    pose = moved(rng, over_the_board(rng))
    pose.p[::3, 1], pose.R[1::3, 0, 2] = bad, np.nan if abs(bad) < 1e30 else bad
    found = estimate(pose)
    np.testing.assert_allclose(found.p_world_trocar, TRUE, atol=1e-5)
    assert (np.asarray(found.weight)[::3] == 0.0).all() and found.is_determined


def few(rng, count, noise=3e-4):
    """Many motions of a few poses in a cone of 25 degrees."""
    half = np.deg2rad(12.5) * np.sqrt(rng.uniform(size=(200, count)))
    around = 2 * np.pi * (np.arange(count) / count + rng.uniform(size=(200, 1)))
    across = np.sin(half)[..., None] * np.stack([np.cos(around), np.sin(around)], -1)
    axes = np.concatenate([across, -np.cos(half)[..., None]], -1)
    tips = (TRUE + 0.1 * axes).astype(np.float32)
    return moved(rng, tips, noise)


@pytest.mark.parametrize("count", [3, 4, 5])
def test_of_few_poses_it_is_the_least_squares_or_unknown(rng, estimate, count):
    """Never a point far off that looks measured: the covariance covers the error."""
    found = estimate(few(rng, count))
    error = np.linalg.norm(np.asarray(found.p_world_trocar) - TRUE, axis=-1)
    known = np.asarray(found.is_determined)
    assert known.mean() > 0.9 and np.isnan(error[~known]).all()
    assert np.nanmax(error) < 0.02 and np.nanmedian(error) < 1.5e-3


def test_two_poses_are_none(rng, estimate):
    assert np.isnan(estimate(few(rng, 2)).p_world_trocar).all()


def test_ten_poses_over_twenty_degrees_are_enough(rng, estimate):
    found = estimate(few(rng, 10))
    deviation = np.sqrt(np.trace(found.covariance, axis1=-2, axis2=-1))
    error = np.linalg.norm(np.asarray(found.p_world_trocar) - TRUE, axis=-1)
    assert found.is_determined.all() and np.median(deviation) < 1e-3
    assert np.mean(error < 3.0 * deviation) > 0.9


def undetermined(rng):
    straight = np.tile(np.float32([0.01, 0.0, 0.02]), (300, 1))
    one = moved(rng, straight)
    sliding = moved(rng, TRUE + np.linspace(0.3, 1.0, 300)[:, None] * (straight - TRUE))
    still = rcm.Pose(np.tile(np.eye(3, dtype=np.float32), (300, 1, 1)), over_the_board(rng))
    few = jax.tree.map(np.copy, moved(rng, over_the_board(rng)))
    few.p[2:] = np.nan
    nothing = jax.tree.map(lambda x: np.full_like(x, np.nan), one)
    narrow = moved(rng, over_the_board(rng, width=0.003))
    return {"roll": one, "slide": sliding, "parallel": still, "few": few, "none": nothing} | {
        "narrow": narrow
    }


@pytest.mark.parametrize("name", ["roll", "slide", "parallel", "few", "none", "narrow"])
def test_a_motion_that_says_nothing_is_refused(rng, estimate, name):
    pose = undetermined(rng)[name]
    found = estimate(pose)
    assert not found.is_determined and np.isnan(found.p_world_trocar).all()
    assert all(np.isfinite(x).all() for x in found[1:])
    assert np.trace(found.covariance) > 1e6


def test_a_fan_in_one_plane_is_enough(rng, estimate):
    tips = np.linspace([-0.03, 0, 0.01], [0.03, 0, 0.01], 100).astype(np.float32)
    np.testing.assert_allclose(estimate(moved(rng, tips)).p_world_trocar, TRUE, atol=3e-6)


def test_it_is_total(rng, estimate, oracle):
    """Any bits at all: finite results, or refused."""
    shape = (2000, 12)
    pose = rcm.Pose(oracle.hostile(rng, (*shape, 3, 3)), oracle.hostile(rng, (*shape, 3)))
    found = estimate(pose)
    known = np.isfinite(found.p_world_trocar).all(-1)
    assert (known == found.is_determined).all()
    assert all(np.isfinite(x).all() for x in found[1:])
    assert (np.asarray(found.weight) >= 0.0).all() and (np.asarray(found.weight) <= 1.0).all()


def test_derivatives_are_finite_also_where_it_is_refused(rng):
    poses = [moved(rng, over_the_board(rng)), *undetermined(rng).values()]
    given = jax.tree.map(lambda *x: jnp.stack(x), *poses)
    grad = jax.jit(jax.grad(lambda pose: rcm.trocar_from_poses(pose).p_world_trocar.sum()))(given)
    assert all(np.isfinite(leaf).all() for leaf in grad)


@pytest.mark.parametrize("shapes", [((3, 3), (3,)), ((5, 3, 3), (4, 3)), ((2, 5, 3, 3), (5, 3))])
def test_shapes_are_named(shapes):
    with pytest.raises(ValueError, match="pose"):
        rcm.trocar_from_poses(rcm.Pose(*map(np.zeros, shapes)))


WRIST = rcm.LARGE_NEEDLE_DRIVER


def bent(rng, degrees):
    """Shafts through the trocar, and tips and angles of wrists that move by so much."""
    shaft = moved(rng, over_the_board(rng))
    angles = np.deg2rad(degrees * rng.uniform(-1.0, 1.0, (300, 2))).astype(np.float32)
    return shaft, rcm.tip_of(WRIST, shaft, angles), angles


@pytest.mark.parametrize("degrees", [5.0, 10.0, 40.0, 80.0])
def test_a_bent_wrist_is_no_straight_shaft(rng, estimate, degrees):
    """Tips of a wrist fit every trocar, so their common point means nothing."""
    _, tip, _ = bent(rng, degrees)
    found = estimate(tip)
    assert not found.is_determined and not found.is_straight
    assert found.residual > rcm.MAX_RESIDUAL and np.trace(found.covariance) > 1e6
    why = rcm.why_undetermined(found)
    assert "wrist" in why and "\n" not in why


@pytest.mark.parametrize("degrees", [1.0, 2.0])
def test_the_point_of_a_wrist_that_hardly_bends_is_off_by_the_residual_at_most(estimate, degrees):
    """Angles that lean with the time are no independent errors: the covariance misses them."""
    rng = np.random.default_rng(1)
    shaft = moved(rng, over_the_board(rng))
    swing = np.sin(np.linspace(0.0, 20.0, 300))[:, None] * [1.0, 0.7]
    found = estimate(rcm.tip_of(WRIST, shaft, np.deg2rad(degrees * swing).astype(np.float32)))
    off = np.linalg.norm(found.p_world_trocar - TRUE)
    assert found.is_determined
    assert np.sqrt(np.linalg.eigvalsh(found.covariance)[-1]) < off < found.residual


@pytest.mark.parametrize("degrees", [0.0, 10.0, 80.0])
def test_with_angles_or_shafts_a_wrist_gives_the_trocar(rng, estimate, degrees):
    shaft, tip, angles = bent(rng, degrees)
    wrong = tip.p.at[::10].add(0.05)
    lost = angles.copy()
    lost[1::10, 0] = np.nan
    with_angles = jax.jit(lambda pose, angles: rcm.trocar_from_poses(pose, WRIST, angles))
    for found in (
        estimate(shaft),
        with_angles(tip, angles),
        with_angles(tip._replace(p=wrong), lost),
    ):
        np.testing.assert_allclose(found.p_world_trocar, TRUE, atol=3e-6)
        assert found.is_determined and rcm.why_undetermined(found) == ""
    with pytest.raises(ValueError, match="angles"):
        rcm.trocar_from_poses(tip, WRIST)


def test_a_trocar_that_yields_by_a_few_millimetres_is_determined(rng, estimate):
    found = estimate(moved(rng, over_the_board(rng), 2e-3))
    assert found.is_determined and 2e-3 < found.residual < rcm.MAX_RESIDUAL


def test_the_first_undetermined_arm_has_its_reason(rng, estimate):
    poses = [moved(rng, over_the_board(rng)), undetermined(rng)["parallel"], bent(rng, 20.0)[1]]
    found = estimate(jax.tree.map(lambda *x: np.stack(x), *poses))
    np.testing.assert_array_equal(found.is_determined, [True, False, False])
    reasons = [rcm.why_undetermined(jax.tree.map(lambda x: x[i:], found)) for i in range(3)]  # noqa: B023
    assert reasons[0] == reasons[1] != reasons[2] and all(reasons)
