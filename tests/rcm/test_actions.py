"""Every action space: total for any input, on the manifold, invertible, differentiable."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import transform

from starjax import rcm

STRAIGHT = {name: space for name, space in rcm.ACTION_SPACES.items() if not space.for_wrist}
SPACES = pytest.mark.parametrize("space", STRAIGHT.values(), ids=STRAIGHT.keys())
# Spaces of a fixed yaw take another frame and the same maps.
OWN_FRAMES = pytest.mark.parametrize(
    "space",
    [space for name, space in STRAIGHT.items() if "fixed_yaw" not in name],
    ids=lambda space: space.name,
)
MANIFOLD_SPACES = pytest.mark.parametrize(
    "name", [name for name, space in STRAIGHT.items() if not space.is_free]
)
EACH = 1_000_000 // len(STRAIGHT)
N = 20_000


def sample_trocars(n):
    return rcm.sample_trocar(jax.random.key(0), (n,))


def sample_poses(rng, n, p_world_trocar):
    """Poses of the manifold with the tool anywhere but within 15 degrees of straight up."""
    axis = rng.normal(size=(3 * n, 3))
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    axis = axis[axis[:, 2] < 0.965][:n].astype(np.float32)
    roll = rng.uniform(-3, 3, n).astype(np.float32)
    depth = rng.uniform(0.01, 0.39, n).astype(np.float32)
    return jax.jit(rcm.pose_on_manifold)(axis, roll, depth, p_world_trocar)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@SPACES
def test_a_million_hostile_actions(space, rng, oracle, p_world_ref):
    trocar = sample_trocars(EACH)
    p_world_trocar = oracle.trocar_position(trocar, p_world_ref)
    action = oracle.hostile_actions(rng, space, p_world_trocar)
    decode = jax.jit(jax.vmap(space.decode, (0, 0, None)))
    pose, valid = jax.tree.map(np.asarray, decode(action, trocar, p_world_ref))
    assert np.isfinite(pose.R).all() and np.isfinite(pose.p).all()
    oracle.check_rotations(pose.R)
    is_finite = np.isfinite(action).all(axis=-1)
    np.testing.assert_array_equal(valid, is_finite)
    assert 0.02 < np.mean(~valid) < 0.5
    if space.name == "se3":
        assert np.abs(pose.p).max() == rcm.MAX_REACH
    else:
        assert oracle.rcm_error(pose.R, pose.p, p_world_trocar).max() <= 1e-6
        depth = np.linalg.norm(pose.p - p_world_trocar, axis=-1)
        assert depth.min() >= rcm.MIN_DEPTH - 1e-6 and depth.max() <= rcm.MAX_DEPTH + 1e-6
    np.testing.assert_array_equal(pose.R[~valid], np.broadcast_to(HOLD_R, pose.R[~valid].shape))
    hold = p_world_trocar[~valid] - [0, 0, rcm.HOLD_DEPTH]
    np.testing.assert_allclose(pose.p[~valid], hold, atol=1e-7)


HOLD_R = np.diag([1.0, -1.0, -1.0])


@SPACES
def test_hostile_trocars(space, rng, oracle):
    trocar = rcm.Trocar(*(oracle.hostile(rng, N) for _ in range(3)))
    p_world_ref = oracle.hostile(rng, (N, 3))
    action = rng.normal(size=(N, space.dim)).astype(np.float32)
    pose, valid = jax.jit(space.decode)(action, trocar, p_world_ref)
    assert np.isfinite(pose.R).all() and np.isfinite(pose.p).all()
    oracle.check_rotations(pose.R)
    everything = np.concatenate([np.stack(trocar, axis=-1), p_world_ref], axis=-1)
    np.testing.assert_array_equal(valid, np.isfinite(everything).all(axis=-1))


@SPACES
def test_hold_pose_without_a_trocar(space, p_world_ref):
    """Below the nominal port if the trocar is not finite, below the origin if that is not."""
    trocar = rcm.Trocar(np.float32(np.nan), 1.5, 0.0)
    down = np.array([0, 0, -rcm.HOLD_DEPTH])
    pose, valid = space.decode(np.zeros(space.dim), trocar, p_world_ref)
    assert not valid
    np.testing.assert_allclose(pose.p, p_world_ref + down, atol=1e-7)
    pose, _ = space.decode(np.zeros(space.dim), trocar, np.full(3, np.inf))
    np.testing.assert_allclose(pose.p, down, atol=1e-7)
    np.testing.assert_array_equal(pose.R, HOLD_R)


@pytest.mark.parametrize("name", ["rcm2", "rcm2_fixed_yaw", "rcm4"])
def test_tip_at_the_trocar_takes_the_axis_straight_down(name, p_world_ref):
    trocar = jax.tree.map(lambda field: field[0], rcm.TROCARS)
    p_world_trocar = np.asarray(rcm.trocar_position(trocar, p_world_ref))
    tip = p_world_trocar if name == "rcm4" else np.zeros(3)
    pose, valid = rcm.ACTION_SPACES[name].decode(np.append(0.4, tip), trocar, p_world_ref)
    assert valid
    np.testing.assert_allclose(pose.p, p_world_trocar - [0, 0, rcm.MIN_DEPTH], atol=1e-7)
    np.testing.assert_allclose(rcm.roll_of(pose.R), 0.4, atol=1e-6)


@OWN_FRAMES
def test_derivatives_are_finite_at_hostile_actions(space, rng, oracle, p_world_ref):
    trocar = sample_trocars(N // 4)
    action = oracle.hostile_actions(rng, space, oracle.trocar_position(trocar, p_world_ref))
    weights = rng.normal(size=12).astype(np.float32)

    def total(action, trocar, p_world_ref):
        pose, _ = space.decode(action, trocar, p_world_ref)
        return pose.R.ravel() @ weights[:9] + pose.p @ weights[9:]

    def again(action, trocar, p_world_ref):
        pose, _ = space.decode(action, trocar, p_world_ref)
        return space.encode(pose, trocar, p_world_ref)

    def derivatives(*arguments):
        kinds = jax.grad(total, (0, 1, 2)), jax.jacfwd(total), jax.jacrev(again)
        return [derivative(*arguments) for derivative in kinds]

    values = jax.jit(jax.vmap(derivatives, (0, 0, None)))(action, trocar, p_world_ref)
    assert all(np.isfinite(value).all() for value in jax.tree.leaves(values))


@OWN_FRAMES
def test_derivatives_equal_finite_differences(space, rng, oracle, p_world_ref):
    trocar = sample_trocars(64)
    pose = sample_poses(rng, 64, oracle.trocar_position(trocar, p_world_ref))

    @jax.jit
    def slopes(pose, trocar):
        action = space.encode(pose, trocar, p_world_ref)

        def flat(action):
            pose, _ = space.decode(action, trocar, p_world_ref)
            return jnp.concatenate([pose.R.reshape(64, 9), pose.p], axis=-1)

        def along(direction):
            tangent = jnp.broadcast_to(direction, action.shape)
            _, slope = jax.jvp(flat, (action,), (tangent,))
            return slope, (flat(action + 1e-6 * tangent) - flat(action - 1e-6 * tangent)) / 2e-6

        return jax.vmap(along)(np.eye(space.dim))

    with jax.enable_x64(True):
        wide = jax.tree.map(lambda value: np.asarray(value, np.float64), (pose, trocar))
        slope, numeric = slopes(*wide)
    assert slope.dtype == np.float64 and np.abs(slope).max((1, 2)).min() > 0.1
    np.testing.assert_allclose(slope, numeric, atol=1e-6, rtol=1e-6)


@SPACES
def test_round_trips(space, rng, oracle, p_world_ref):
    trocar = sample_trocars(N)
    pose = sample_poses(rng, N, oracle.trocar_position(trocar, p_world_ref))

    @jax.jit
    def there_and_back(pose, trocar):
        action = space.encode(pose, trocar, p_world_ref)
        back, valid = space.decode(action, trocar, p_world_ref)
        return action, back, valid, space.encode(back, trocar, p_world_ref)

    action, back, valid, again = there_and_back(pose, trocar)
    assert action.shape == (N, space.dim)
    assert valid.all()
    np.testing.assert_allclose(back.R, pose.R, atol=1e-5)
    np.testing.assert_allclose(back.p, pose.p, atol=1e-6)
    np.testing.assert_allclose(again, action, atol=1e-5)


@SPACES
def test_decode_equals_the_paper_in_float64(space, rng, oracle, p_world_ref):
    trocar = sample_trocars(N)
    pose = sample_poses(rng, N, oracle.trocar_position(trocar, p_world_ref))
    action = np.asarray(jax.jit(space.encode)(pose, trocar, p_world_ref))
    R, p = oracle.decode(space.name, action, trocar, p_world_ref)
    decode = jax.jit(space.decode)
    decoded, _ = decode(action, trocar, p_world_ref)
    np.testing.assert_allclose(decoded.R, R, atol=1e-5)
    np.testing.assert_allclose(decoded.p, p, atol=1e-6)
    with jax.enable_x64(True):
        wide = jax.tree.map(lambda value: np.asarray(value, np.float64), (action, trocar))
        decoded, _ = decode(*wide, p_world_ref)
        assert decoded.R.dtype == decoded.p.dtype == np.float64
        np.testing.assert_allclose(decoded.R, R, atol=1e-12)
        np.testing.assert_allclose(decoded.p, p, atol=1e-12)


@SPACES
def test_parts_are_what_their_names_say(space, rng, oracle, p_world_ref):
    trocar = jax.tree.map(lambda field: field[3], rcm.TROCARS)
    p_world_trocar = np.asarray(rcm.trocar_position(trocar, p_world_ref))
    pose = jax.tree.map(lambda value: value[0], sample_poses(rng, 1, p_world_trocar))
    is_relative = space.name.startswith(("rcm1", "rcm2"))
    is_fixed = space.name.endswith("_fixed_yaw")
    R_trocar = HOLD_R if is_fixed else oracle.trocar_rotation(trocar).astype(np.float32)
    R = R_trocar.T @ pose.R if is_relative else pose.R
    p = R_trocar.T @ (pose.p - p_world_trocar) if is_relative else pose.p
    expected = {
        "p": p,
        "R": np.concatenate([R[:, 0], R[:, 1]]),
        "depth": np.linalg.norm(pose.p - p_world_trocar),
        "roll": rcm.roll_of(pose.R),
    }
    action = np.asarray(space.encode(pose, trocar, p_world_ref))
    covered = np.zeros(space.dim, int)
    for part, where in space.slices.items():
        np.testing.assert_allclose(action[where], np.atleast_1d(expected[part]), atol=1e-6)
        covered[where] += 1
    assert (covered == 1).all()


@SPACES
def test_broadcasting_vmap_and_dtypes_agree(space, rng, p_world_ref):
    action = rng.normal(scale=0.2, size=(5, 12, space.dim)).astype(np.float32)
    pose, valid = jax.jit(space.decode)(action, rcm.TROCARS, p_world_ref)
    assert pose.R.shape == (5, 12, 3, 3) and pose.p.shape == (5, 12, 3) and valid.shape == (5, 12)
    assert pose.R.dtype == pose.p.dtype == np.float32 and valid.dtype == bool
    mapped = jax.jit(jax.vmap(jax.vmap(space.decode, (0, 0, None)), (0, None, None)))
    for one, other in zip(pose, mapped(action, rcm.TROCARS, p_world_ref)[0], strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)
    # One pose seen from twelve trocars.
    pose = jax.tree.map(lambda value: value[0, 0], pose)
    encoded = jax.eval_shape(space.encode, pose, rcm.TROCARS, p_world_ref)
    assert encoded.shape == (12, space.dim)


@SPACES
@pytest.mark.parametrize("dtype", ["bfloat16", "float16", "int32", "float32"])
def test_results_have_at_least_float32(space, dtype, p_world_ref):
    action = jax.numpy.ones(space.dim, dtype)
    pose, _ = jax.eval_shape(space.decode, action, rcm.Trocar(0.02, 1.5, 0), p_world_ref)
    for value in pose:
        assert value.dtype == np.float32 and not value.weak_type


@SPACES
def test_wrong_shapes_are_named(space, p_world_ref):
    trocar = rcm.Trocar(0.02, 1.5, 0.3)
    with pytest.raises(ValueError, match=rf"action: expected .*{space.dim}\], got \[2, 3\]"):
        space.decode(np.zeros((2, 3)), trocar, p_world_ref)
    with pytest.raises(ValueError, match=r"p_world_ref: expected .*3\], got \[\]"):
        space.decode(np.zeros(space.dim), trocar, 0.15)
    with pytest.raises(ValueError, match=r"leading axes .* got action \[5\], trocar.radius \[12\]"):
        space.decode(np.zeros((5, space.dim)), rcm.TROCARS, p_world_ref)
    with pytest.raises(ValueError, match=r"pose.p: expected .*3\], got \[2\]"):
        space.encode(rcm.Pose(R=np.eye(3), p=np.zeros(2)), trocar, p_world_ref)


@MANIFOLD_SPACES
def test_encode_describes_poses_off_the_manifold(name, rng, p_world_ref):
    """A measured pose, its shaft 1 mm from the trocar: signed depth, and the pose's own roll."""
    space = rcm.ACTION_SPACES[name]
    trocar = rcm.Trocar(0.02, 1.5, 0.3)
    R = transform.Rotation.from_euler("xyz", [2.9, 0.2, 0.5]).as_matrix().astype(np.float32)
    p_world_trocar = np.asarray(rcm.trocar_position(trocar, p_world_ref))
    pose = rcm.Pose(R=R, p=p_world_trocar + np.float32(-0.02) * R[:, 2] + 1e-3 * R[:, 0])
    action = np.asarray(space.encode(pose, trocar, p_world_ref))
    if "depth" in space.slices:
        np.testing.assert_allclose(action[space.slices["depth"]], -0.02, atol=1e-7)
    else:
        np.testing.assert_allclose(action[space.slices["roll"]], rcm.roll_of(R), atol=1e-6)


def test_encode_propagates_nan(p_world_ref):
    pose = rcm.Pose(R=np.full((3, 3), np.nan), p=np.full(3, np.nan))
    for space in STRAIGHT.values():
        assert np.isnan(space.encode(pose, rcm.Trocar(0.02, 1.5, 0.3), p_world_ref)).all()


@pytest.mark.parametrize("column", [0, 2])
def test_a_roll_needs_a_jaw_and_an_axis(p_world_ref, column):
    R = np.diag([1.0, -1.0, -1.0])
    R[1, column] = np.nan
    for name in ("rcm2", "rcm4"):
        space = rcm.ACTION_SPACES[name]
        action = space.encode(rcm.Pose(R, p_world_ref), rcm.Trocar(0.02, 1.5, 0.3), p_world_ref)
        assert np.isnan(action[space.slices["roll"]]).all() and np.isfinite(action[1:]).all()


@SPACES
def test_a_resolved_trocar_gives_the_same_actions_and_poses(space):
    p_world_ref = jnp.array([0.01, -0.02, 0.15])

    @jax.jit
    def both(action, trocar):
        frame = rcm.trocar_frame(trocar, p_world_ref)
        pose, valid = space.decode(action, trocar, p_world_ref)
        plain = pose, valid, space.encode(pose, trocar, p_world_ref)
        return plain, (*space.decode(action, frame), space.encode(pose, frame))

    key_trocar, key_action = jax.random.split(jax.random.key(3))
    action = jax.random.normal(key_action, (50, space.dim))
    plain, resolved = both(action, rcm.sample_trocar(key_trocar, (50,)))
    chex.assert_trees_all_close(resolved, plain, atol=1e-6)


def test_rolls_count_from_the_frame_and_never_leave_half_a_turn():
    frame = rcm.trocar_frame(rcm.Trocar(0.03, 1.5, 0.2), jnp.array([0.0, 0.0, 0.15]), jnp.pi)
    rolls = jnp.linspace(-3.1, 3.1, 40)
    action = jnp.concatenate([rolls[:, None], jnp.full((40, 3), 0.01)], -1)

    @jax.jit
    def turned(frame):
        found = []
        for space in (rcm.ACTION_SPACES[name] for name in ("rcm4", "rcm2")):
            pose, _ = space.decode(action, frame)
            plain, _ = space.decode(action, frame._replace(roll_zero=0.0))
            found.append((space.encode(pose, frame), pose, plain))
        return found

    for again, pose, plain in turned(frame):
        np.testing.assert_allclose(again[:, 0], rolls, atol=1e-4)
        np.testing.assert_allclose(pose.R[..., :2], -plain.R[..., :2], atol=1e-5)


def test_a_frame_that_is_not_finite_is_held():
    frame = rcm.trocar_frame(rcm.Trocar(0.03, 1.5, 0.2), jnp.array([0.0, 0.0, 0.15]))
    for bad in (
        frame._replace(roll_zero=jnp.nan),
        frame._replace(R_world_trocar=frame.R_world_trocar * jnp.inf),
        frame._replace(p_world_trocar=frame.p_world_trocar * jnp.nan),
    ):
        pose, valid = rcm.ACTION_SPACES["rcm2"].decode(jnp.ones(4) * 0.1, bad)
        assert not valid and all(bool(jnp.isfinite(x).all()) for x in pose)
