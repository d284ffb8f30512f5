"""Trocars: Eq. 2 and {T} against numpy, the twelve, the sampling ranges, errors with values."""

import jax
import numpy as np
import pytest

from starjax import rcm


def sample(n=4096, seed=0):
    return rcm.sample_trocar(jax.random.key(seed), (n,))


def test_position_and_frame_equal_numpy(oracle, p_world_ref):
    trocar = sample()
    p = jax.jit(rcm.trocar_position)(trocar, p_world_ref)
    np.testing.assert_allclose(p, oracle.trocar_position(trocar, p_world_ref), atol=3e-8)
    R = rcm.trocar_rotation(trocar)
    np.testing.assert_allclose(R, oracle.trocar_rotation(trocar), atol=3e-7)
    oracle.check_rotations(R, atol=1e-6)


def test_a_measured_position_has_the_parameters_it_was_made_of(p_world_ref):
    drawn = rcm.sample_trocar(jax.random.key(2), (4096,), radius_range=(1e-3, 0.05))
    for trocar in (drawn, rcm.TROCARS):
        p = np.float64(p_world_ref) + rcm.trocar_position(trocar, np.zeros(3))
        # In double precision, as float32 metres about 0.15 are a ten-thousandth of 1e-3 m apart.
        with jax.enable_x64(True):
            found = jax.jit(rcm.trocar_from_position)(p, np.float64(p_world_ref))
            for got, field in zip(found, trocar, strict=True):
                np.testing.assert_allclose(got, field, atol=2e-5 * np.abs(field).max())
    found = rcm.check_trocar(rcm.trocar_from_position(p.astype(np.float32), p_world_ref))
    np.testing.assert_allclose(rcm.trocar_position(found, p_world_ref), p, atol=3e-8)


def test_a_position_that_says_nothing_of_an_angle(p_world_ref):
    offset = np.array([[0, 0, 0], [1e-7, 0, -1e-7], [0, 0, 0.03], [-1e-7, 0, -0.03]], np.float32)
    found = rcm.trocar_from_position(offset, np.zeros(3))
    np.testing.assert_allclose(found.radius, [0, 0, 0.03, 0.03], atol=2e-7)
    np.testing.assert_allclose(found.polar, [np.pi / 2, np.pi / 2, 0, np.pi], atol=1e-5)
    np.testing.assert_array_equal(found.azimuth, 0)
    jacobian = jax.vmap(jax.jacfwd(lambda p: rcm.trocar_from_position(p, np.zeros(3))))(offset)
    assert all(np.isfinite(field).all() for field in jacobian)
    for bad in (np.nan, np.inf, -np.inf):
        assert np.isnan(rcm.trocar_from_position([0.0, bad, 0.1], p_world_ref)).all()
    with pytest.raises(ValueError, match=r"p_world_trocar: expected .*3\], got \[2\]"):
        rcm.trocar_from_position(np.zeros(2), p_world_ref)


def test_position_and_frame_have_one_batch(p_world_ref):
    trocar = rcm.Trocar(np.full((4, 1), 0.02), np.pi / 2, np.zeros(3))
    assert rcm.trocar_position(trocar, p_world_ref).shape == (4, 3, 3)
    assert rcm.trocar_rotation(trocar).shape == (4, 3, 3, 3)


def test_frame_points_down_and_along_the_azimuth():
    R = rcm.trocar_rotation(rcm.Trocar(0.04, 1.4, np.pi / 2))
    np.testing.assert_allclose(R[:, 0], [0, 1, 0], atol=1e-7)
    np.testing.assert_allclose(R[:, 2], [0, 0, -1], atol=1e-7)


def test_the_twelve():
    assert rcm.IS_SEEN.tolist() == [True] * 8 + [False] * 4
    radius, polar, azimuth = (np.asarray(field, np.float64) for field in rcm.TROCARS)
    np.testing.assert_allclose(radius, np.array([4, 2] * 4 + [5, 5, 5, 0]) / 100, atol=1e-8)
    degrees = [80, 80, 100, 100] * 2 + [70, 110, 90, 90]
    np.testing.assert_allclose(np.rad2deg(polar), degrees, atol=1e-5)
    degrees = [45 * k for k in range(8)] + [67.5, 247.5, 157.5, 0]
    np.testing.assert_allclose(np.rad2deg(azimuth), degrees, atol=2e-5)
    assert all(field.dtype == np.float32 and field.shape == (12,) for field in rcm.TROCARS)
    assert all(not field.flags.writeable for field in rcm.TROCARS)
    rcm.check_trocar(rcm.TROCARS)


def test_the_twelve_lie_in_the_sampling_ranges():
    ranges = (rcm.RADIUS_RANGE, rcm.POLAR_RANGE, rcm.AZIMUTH_RANGE)
    for field, (low, high) in zip(rcm.TROCARS, ranges, strict=True):
        assert field.min() >= low - 1e-6 and field.max() <= high + 1e-6
    np.testing.assert_allclose(np.rad2deg(rcm.POLAR_RANGE), [70, 110])
    np.testing.assert_allclose(np.rad2deg(rcm.POLAR_RANGE_WIDE), [60, 120])


def test_samples_fill_their_ranges_evenly():
    trocar = rcm.sample_trocar(
        jax.random.key(1), (3, 20_000), polar_range=rcm.POLAR_RANGE_WIDE, radius_range=(0.01, 0.02)
    )
    ranges = ((0.01, 0.02), rcm.POLAR_RANGE_WIDE, rcm.AZIMUTH_RANGE)
    for field, (low, high) in zip(trocar, ranges, strict=True):
        assert field.shape == (3, 20_000)
        counts, _ = np.histogram(field, bins=10, range=(low, high))
        assert counts.sum() == field.size
        np.testing.assert_allclose(counts, field.size / 10, rtol=0.05)
    correlation = np.corrcoef([np.ravel(field) for field in trocar])
    assert np.abs(correlation - np.eye(3)).max() < 0.02


def test_sampling_depends_on_the_key_only():
    for one, two, other in zip(sample(), sample(), sample(seed=1), strict=True):
        np.testing.assert_array_equal(one, two)
        assert not np.array_equal(one, other)
    assert rcm.sample_trocar(jax.random.key(0)).radius.shape == ()


@pytest.mark.parametrize(
    ("name", "bounds"),
    [
        ("radius_range", (-0.01, 0.05)),
        ("radius_range", (0.05, 0.01)),
        ("radius_range", (0.0, np.inf)),
        ("polar_range", (1.0, 4.0)),
        ("polar_range", (np.nan, 1.0)),
        ("azimuth_range", (0.0, 1.0, 2.0)),
    ],
)
def test_bad_ranges_are_named(name, bounds):
    with pytest.raises(ValueError, match=f"{name}: expected .* got"):
        rcm.sample_trocar(jax.random.key(0), **{name: bounds})


@pytest.mark.parametrize(
    ("trocar", "message"),
    [
        (rcm.Trocar(-0.01, 1.5, 0.0), r"trocar.radius: expected .*\[0, inf\], got -0.01"),
        (rcm.Trocar([0.01, np.nan], 1.5, 0.0), r"trocar.radius: .* got nan"),
        (rcm.Trocar(0.01, 3.5, 0.0), r"trocar.polar: expected .*\[0, 3.14159\], got 3.5"),
        (rcm.Trocar(0.01, 1.5, np.inf), r"trocar.azimuth: .* got inf"),
        (rcm.Trocar(np.zeros(2), np.zeros(3), 0.0), r"trocar.radius \[2\], trocar.polar \[3\]"),
    ],
)
def test_check_trocar_names_what_is_wrong(trocar, message):
    with pytest.raises(ValueError, match=message):
        rcm.check_trocar(trocar)


def test_check_trocar_passes_traced_values():
    trocar = jax.jit(rcm.check_trocar)(rcm.Trocar(-0.01, 1.5, 0.0))
    assert float(trocar.radius) == pytest.approx(-0.01)
    with pytest.raises(ValueError, match=r"trocar\.polar: .*got nan"):
        jax.jit(lambda radius: rcm.check_trocar(rcm.Trocar(radius, np.nan, 0.0)))(0.02)


def test_shape_errors_name_the_argument():
    with pytest.raises(ValueError, match=r"p_world_ref: expected .*3\], got \[2\]"):
        rcm.trocar_position(rcm.Trocar(0.01, 1.5, 0.0), np.zeros(2))
    with pytest.raises(ValueError, match=r"expected leading axes that broadcast"):
        rcm.trocar_position(rcm.Trocar(np.zeros(5), 1.5, 0.0), np.zeros((4, 3)))


def test_float32s_pi_is_a_polar_angle(p_world_ref):
    """A trocar straight below the nominal port, whose angle is rounded up."""
    below = rcm.trocar_from_position(np.array([0.0, 0.0, -0.03], np.float32), np.zeros(3))
    assert float(below.polar) > np.pi
    rcm.check_trocar(below)
    rcm.sample_trocar(jax.random.key(0), polar_range=(0.0, np.float32(np.pi)))


def test_trocars_are_drawn_from_eq_19_by_default():
    ranges = (rcm.RADIUS_RANGE, rcm.POLAR_RANGE, rcm.AZIMUTH_RANGE)
    for field, (low, high) in zip(sample(), ranges, strict=True):
        counts, _ = np.histogram(field, bins=4, range=(low, high))
        assert counts.sum() == field.size and counts.min() > 900
