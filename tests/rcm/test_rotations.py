"""Rotations: their laws on random samples, the places where Eq. 16 breaks, scipy and jaxlie."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial import transform

from starjax import rcm

N = 4096


def as_float32(*arrays):
    return [np.asarray(array, np.float32) for array in arrays]


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def test_align_is_the_smallest_rotation_from_a_to_b(rng, oracle):
    a, b = as_float32(oracle.unit(rng, N), oracle.unit(rng, N))
    R = np.asarray(jax.jit(rcm.rotation_align)(a, b))
    oracle.check_rotations(R, atol=3e-6)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", R, a), b, atol=2e-6)
    angle = np.linalg.norm(transform.Rotation.from_matrix(R).as_rotvec(), axis=-1)
    between = np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))
    np.testing.assert_allclose(angle, between, atol=2e-6)


def test_align_equals_eq16_scipy_and_jaxlie(rng, oracle):
    a, b = as_float32(oracle.unit(rng, N), oracle.unit(rng, N))
    far = np.sum(a * b, axis=-1) > -0.99
    a, b = a[far], b[far]
    R = np.asarray(rcm.rotation_align(a, b))
    a, b = a.astype(np.float64), b.astype(np.float64)
    a, b = (v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (a, b))
    np.testing.assert_allclose(R, oracle.align(a, b), atol=3e-6)
    k = np.cross(a, b)
    sin = np.linalg.norm(k, axis=-1, keepdims=True)
    rotvec = k / sin * np.arctan2(sin, np.sum(a * b, axis=-1, keepdims=True))
    np.testing.assert_allclose(R, transform.Rotation.from_rotvec(rotvec).as_matrix(), atol=3e-6)
    lie = jax.vmap(lambda v: jaxlie.SO3.exp(v).as_matrix())(rotvec.astype(np.float32))
    np.testing.assert_allclose(R, lie, atol=5e-6)


@pytest.mark.parametrize("gap", [1.0, 1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 2e-6, 1e-7, 1e-12, 0.0])
@pytest.mark.parametrize("side", ["equal", "opposite"])
def test_align_near_equal_and_near_opposite(rng, oracle, gap, side):
    a = oracle.unit(rng, 256)
    across = np.cross(a, oracle.unit(rng, 256))
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    b = (np.cos(gap) * a + np.sin(gap) * across) * (1 if side == "equal" else -1)
    R = np.asarray(jax.jit(rcm.rotation_align)(*as_float32(a, b)), np.float64)
    oracle.check_rotations(R, atol=3e-6)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", R, a), b, atol=2.5e-6)


def test_align_of_opposite_axes_is_the_documented_half_turn():
    e_z = np.array([0.0, 0.0, 1.0], np.float32)
    R = rcm.rotation_align(e_z, -e_z)
    np.testing.assert_allclose(R, np.diag([1.0, -1.0, -1.0]), atol=3e-7)


def test_rotations_are_total(rng, oracle):
    a, b = oracle.hostile(rng, (N, 3)), oracle.hostile(rng, (N, 3))
    oracle.check_rotations(jax.jit(rcm.rotation_align)(a, b))
    oracle.check_rotations(jax.jit(rcm.rot6d_decode)(np.concatenate([a, b], axis=-1)))
    finite = np.nan_to_num(a[:, 0], nan=0.0)
    oracle.check_rotations(jax.jit(rcm.rotation_z)(finite.clip(-3e38, 3e38)))


def test_rotation_z_equals_scipy_and_jaxlie(rng):
    angle = rng.uniform(-20, 20, N).astype(np.float32)
    R = np.asarray(rcm.rotation_z(angle))
    expected = transform.Rotation.from_euler("z", angle.astype(np.float64)[:, None]).as_matrix()
    np.testing.assert_allclose(R, expected, atol=2e-6)
    np.testing.assert_allclose(R, jax.vmap(jaxlie.SO3.from_z_radians)(angle).as_matrix(), atol=4e-6)


def test_axis_and_roll_come_back(rng, oracle):
    axis = oracle.unit(rng, N)
    axis = axis[axis[:, 2] < 0.99]  # the chart ends where the tool points straight up
    roll = rng.uniform(-3.14, 3.14, len(axis))
    axis, roll = as_float32(axis, roll)
    R = jax.jit(rcm.rotation_from_axis_roll)(axis, roll)
    oracle.check_rotations(R)
    np.testing.assert_allclose(R[..., :, 2], axis, atol=1e-6)
    np.testing.assert_allclose(jax.jit(rcm.roll_of)(R), roll, atol=1e-5)


def test_base_rotation_is_the_alignment_from_the_z_down_frame(rng, oracle):
    """Roll 0 is `G @ rotation_align(e_z, G' @ axis)`, at the singular axis too."""
    (axis,) = as_float32(np.concatenate([oracle.unit(rng, N), [[0, 0, 1], [0, 0, -1], [1, 0, 0]]]))
    G = np.array([1, -1, -1], np.float32)
    e_z = np.array([0, 0, 1], np.float32)
    expected = G[:, None] * jax.jit(rcm.rotation_align)(e_z, G * axis)
    R = jax.jit(rcm.rotation_from_axis_roll)(axis, np.float32(0))
    steady = axis[:, 2] < 0.999
    np.testing.assert_allclose(R[steady], expected[steady], atol=1e-5)
    np.testing.assert_allclose(R[-3], expected[-3], atol=3e-7)


def test_roll_is_the_twist_of_jaxlies_quaternion(rng):
    """Swing-twist of G R about z: the roll is twice the angle of (w, z)."""
    R = transform.Rotation.random(N, rng=rng).as_matrix().astype(np.float32)
    R = R[R[:, 2, 2] < 0.99]
    G = np.diag([1.0, -1.0, -1.0]).astype(np.float32)
    w, _, _, z = jax.vmap(lambda M: jaxlie.SO3.from_matrix(M).wxyz)(G @ R).T
    twist = 2 * np.arctan2(z, w)
    gap = np.asarray(jax.jit(rcm.roll_of)(R)) - twist
    np.testing.assert_allclose((gap + np.pi) % (2 * np.pi), np.pi, atol=1e-4)


def test_roll_is_smooth_where_tools_point():
    """Over a 60 degree cone about straight down, 1 mrad of tilt moves the roll by < 2 mrad."""
    tilt = np.linspace(-np.pi / 3, np.pi / 3, 2095)
    for heading in np.linspace(0, np.pi, 7):
        axis = [np.sin(tilt) * np.cos(heading), np.sin(tilt) * np.sin(heading), -np.cos(tilt)]
        x = np.cross([0.0, -1.0, 0.2], np.stack(axis, axis=-1))  # a jaw direction of its own
        x /= np.linalg.norm(x, axis=-1, keepdims=True)
        R = np.stack([x, np.cross(np.stack(axis, -1), x), np.stack(axis, -1)], axis=-1)
        roll = np.asarray(jax.jit(rcm.roll_of)(R.astype(np.float32)))
        assert np.abs(np.diff(roll)).max() < 2e-3


def test_roll_does_not_wrap_below_half_a_turn():
    roll = np.linspace(-3.14, 3.14, 1001, dtype=np.float32)
    R = rcm.rotation_from_axis_roll(np.array([0.3, -0.2, -0.9], np.float32), roll)
    np.testing.assert_allclose(jax.jit(rcm.roll_of)(R), roll, atol=1e-6)


def test_rot6d_round_trip_and_layout(rng):
    R = transform.Rotation.random(N, rng=rng).as_matrix().astype(np.float32)
    rot6d = np.asarray(rcm.rot6d_encode(R))
    np.testing.assert_array_equal(rot6d, np.concatenate([R[..., 0], R[..., 1]], axis=-1))
    np.testing.assert_allclose(rcm.rot6d_decode(rot6d), R, atol=1e-6)
    np.testing.assert_allclose(rcm.rot6d_decode(1e-3 * rot6d), R, atol=1e-6)


def test_derivatives_are_finite_at_singular_points(oracle):
    e_z = np.array([0.0, 0.0, 1.0])
    near_opposite = [[1e-45, 1e-38, -1], [1e-7, 0, -1], [1e-6, -1e-6, -1], [1e-3, 0, -1]]
    b = [e_z, -e_z, 0 * e_z, np.nan * e_z, 1e38 * e_z, -1e38 * e_z, [1e-45, 0, 0], *near_opposite]
    b = np.array(b, np.float32)
    a = np.broadcast_to(e_z, b.shape).astype(np.float32)

    def everything(a, b):
        columns = [jnp.concatenate([a, b]), jnp.concatenate([b, a])]
        return rcm.rotation_align(a, b), [rcm.rot6d_decode(rot6d) for rot6d in columns]

    for mode in (jax.jacfwd, jax.jacrev):
        jacobian = jax.jit(jax.vmap(mode(everything, argnums=(0, 1))))(a, b)
        assert all(np.isfinite(part).all() for part in jax.tree.leaves(jacobian))


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_the_rolls_derivative_is_finite_everywhere(mode):
    R = np.stack([np.zeros((3, 3)), np.eye(3), np.diag([1.0, -1.0, -1.0]), np.zeros((3, 3))])
    R[3, 2, 2] = 1.0  # straight up, and no x axis
    rng = np.random.default_rng(0)
    any_size = rng.choice([-1, 1], (2000, 3, 3)) * 10 ** rng.uniform(-40, 38, (2000, 3, 3))
    R = np.concatenate([R, any_size])
    assert np.isfinite(jax.jit(jax.vmap(mode(rcm.roll_of)))(R.astype(np.float32))).all()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: rcm.rotation_align(np.zeros(3), np.zeros(4)), r"b: expected .*3\], got \[4\]"),
        (lambda: rcm.rot6d_decode(np.zeros((2, 5))), r"rot6d: expected .*6\], got \[2, 5\]"),
        (lambda: rcm.rot6d_encode(np.zeros((3, 2))), r"R: expected .*3, 3\], got \[3, 2\]"),
        (lambda: rcm.roll_of(np.zeros(3)), r"R_world_tip: expected .*3, 3\], got \[3\]"),
        (
            lambda: rcm.rotation_align(np.zeros((2, 3)), np.zeros((4, 3))),
            r"a, b: expected leading axes that broadcast, got a \[2\], b \[4\]",
        ),
    ],
)
def test_bad_shapes_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_what_is_too_short_to_have_a_direction():
    e_x, e_y, e_z = np.eye(3, dtype=np.float32)
    zero = np.zeros(3, np.float32)
    for short in (zero, 1e-7 * e_x):
        np.testing.assert_array_equal(rcm.rotation_align(short, e_y), rcm.rotation_align(e_z, e_y))
        np.testing.assert_array_equal(rcm.rotation_align(e_y, short), rcm.rotation_align(e_y, e_z))
        R = rcm.rotation_from_axis_roll(short, 0.0)
        np.testing.assert_array_equal(R, np.diag([1.0, -1.0, -1.0]))
    np.testing.assert_allclose(rcm.rot6d_decode([*zero, *e_y]), np.eye(3), atol=1e-7)
    with jax.enable_x64(True):  # where 1e-7 is long
        R = rcm.rotation_align(np.float64(e_z), 1e-7 * np.float64(e_x))
        np.testing.assert_allclose(R[:, 2], e_x, atol=1e-12)
