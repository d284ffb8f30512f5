"""A wrist: both ways, against the dVRK's Denavit-Hartenberg parameters, total, differentiable."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import transform

from starjax import rcm

N = 100_000
WRIST = rcm.LARGE_NEEDLE_DRIVER
LIMIT = np.deg2rad(80.0)
SPACE = rcm.rcm6(WRIST)
# Roll offset, clevis and wrist limits of three instruments, as the dVRK describes them.
INSTRUMENTS = {
    "LARGE_NEEDLE_DRIVER_400006": (0.4162, 0.0091, 80.0),
    "PROGRASP_FORCEPS_420093": (0.4670, 0.0107, 80.0),
    "MEGA_NEEDLE_DRIVER_420194": (0.4670, 0.0112, 70.0),
}


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def turned(R, other):
    """Angles between rotations in rad, exact for small ones."""
    chord = np.linalg.norm(np.float64(R) - np.float64(other), axis=(-2, -1))
    return 2.0 * np.arcsin(np.clip(chord / np.sqrt(8.0), 0.0, 1.0))


def apart(p, other):
    return np.linalg.norm(np.float64(p) - np.float64(other), axis=-1)


def trocars(n, p_world_ref):
    trocar = rcm.sample_trocar(jax.random.key(1), (n,))
    return trocar, np.asarray(rcm.trocar_position(trocar, p_world_ref))


def shafts(rng, n, p_world_trocar):
    """Shafts through trocars, within 70 degrees of straight down; every third is degenerate."""
    tilt, azimuth = rng.uniform(0, np.deg2rad(70), n), rng.uniform(-np.pi, np.pi, n)
    tilt[::3] *= 10.0 ** rng.uniform(-45, 0, len(tilt[::3])) * rng.integers(0, 2, len(tilt[::3]))
    axis = [np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)]
    roll, depth = rng.uniform(-np.pi, np.pi, n), rng.uniform(0.02, 0.24, n)
    make = jax.jit(rcm.pose_on_manifold)
    return make(np.stack(axis, -1).astype(np.float32), *np.float32([roll, depth]), p_world_trocar)


def angles_of(rng, n):
    """Angles within the limits; every third has a zero or a limit."""
    angles = rng.uniform(-LIMIT, LIMIT, (n, 2))
    special = rng.choice([0.0, LIMIT, -LIMIT, 1e-30], angles[::3].shape)
    angles[::3] = np.where(rng.random(angles[::3].shape) < 0.6, special, angles[::3])
    return angles.astype(np.float32)


def board_poses(rng, n):
    """Tips over a board with any rotation."""
    R = transform.Rotation.random(n, rng=rng).as_matrix().astype(np.float32)
    return rcm.Pose(R, rng.uniform([-0.045] * 2 + [0.006], [0.045] * 3, (n, 3)).astype(np.float32))


@jax.jit
def forward(shaft, angles):
    return rcm.tip_of(WRIST, shaft, angles)


@jax.jit
def back(tip, p_world_trocar):
    angles = rcm.angles_through(WRIST, tip, p_world_trocar)
    return angles, rcm.shaft_of(WRIST, tip, angles)


@jax.jit
def through(tip, p_world_trocar):
    return rcm.through(WRIST, tip, p_world_trocar)


def test_a_tip_pose_has_the_angles_and_the_shaft_that_made_it(rng, p_world_ref):
    _, p = trocars(N, p_world_ref)
    shaft, angles = shafts(rng, N, p), angles_of(rng, N)
    tip = forward(shaft, angles)
    found, again = back(tip, p)
    assert np.abs(found - angles).max() < 1e-5
    assert turned(again.R, shaft.R).max() < 1e-5 and apart(again.p, shaft.p).max() < 1e-6
    assert rcm.rcm_error(again, p).max() < 1e-6
    last = forward(again, found)
    assert turned(last.R, tip.R).max() < 1e-5 and apart(last.p, tip.p).max() < 1e-6


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_it_is_the_dvrks_instrument(name, rng):
    """Its tip frame is half a turn about z from ours and ends at the yaw axis."""
    offset, clevis, limit = INSTRUMENTS[name]
    wrist = rcm.Wrist(clevis, 0.0, np.deg2rad(limit), np.deg2rad(80.0))
    q = rng.uniform(-1, 1, (1000, 6)) * [1.5, 0.9, 0.11, 3.0, np.deg2rad(limit), LIMIT]
    q[:, 2] += 0.12
    shaft, tip = dvrk(q, offset, clevis)
    got = rcm.tip_of(wrist, rcm.Pose(shaft[:, :3, :3], shaft[:, :3, 3]), q[:, 4:])
    np.testing.assert_allclose(got.p, tip[:, :3, 3], atol=1e-6)
    np.testing.assert_allclose(got.R, tip[:, :3, :3] @ np.diag([-1.0, -1.0, 1.0]), atol=1e-6)
    # The remote centre is the base frame's origin.
    inserted = (shaft[:, :3, 2] * shaft[:, :3, 3]).sum(-1) > 0.005
    found = rcm.angles_through(wrist, got, np.zeros(3))
    np.testing.assert_allclose(found[inserted], q[inserted, 4:], atol=1e-5)
    for ours, row in ((rcm.LARGE_NEEDLE_DRIVER, "LARGE"), (rcm.PROGRASP, "PROGRASP")):
        if name.startswith(row):
            assert np.allclose(ours, (clevis, 0.0102, np.deg2rad(limit), LIMIT))


def dvrk(q, offset, clevis):
    """Frames `[N, 4, 4]` of shaft, then tip, at joints `[N, 6]`, by the modified DH of psm.json."""
    half = np.pi / 2
    rows = [  # alpha, a, theta, d
        (half, 0.0, q[:, 0] + half, 0.0),
        (-half, 0.0, q[:, 1] - half, 0.0),
        (half, 0.0, 0.0, q[:, 2] - 0.4318),
        (0.0, 0.0, q[:, 3], offset),
        (-half, 0.0, q[:, 4] - half, 0.0),
        (-half, clevis, q[:, 5] - half, 0.0),
    ]
    frames = [np.eye(4)]
    for alpha, a, theta, d in rows:
        c, s, zero = np.cos(theta + 0 * q[:, 0]), np.sin(theta + 0 * q[:, 0]), 0 * q[:, 0]
        ca, sa = np.cos(alpha), np.sin(alpha)
        link = [
            [c, -s, zero, zero + a],
            [s * ca, c * ca, zero - sa, -sa * d + zero],
            [s * sa, c * sa, zero + ca, ca * d + zero],
            [zero, zero, zero, zero + 1.0],
        ]
        frames.append(frames[-1] @ np.moveaxis(np.array(link), -1, 0))
    tooltip = np.array([[0, -1, 0, 0], [0, 0, 1, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])
    return frames[4], frames[6] @ tooltip


def test_any_pose_goes_through_and_keeps_its_tip(rng, p_world_ref):
    _, p = trocars(N, p_world_ref)
    tip = board_poses(rng, N)
    got = through(tip, p)
    shaft = rcm.shaft_of(WRIST, got.pose, got.wrist)
    assert apart(got.pose.p, tip.p).max() < 1e-6 and rcm.rcm_error(shaft, p).max() < 1e-6
    assert np.abs(got.wrist).max() <= np.float32(LIMIT)
    assert rcm.insertion_depth(shaft, p).min() >= rcm.MIN_DEPTH - 1e-6
    inside = np.asarray(got.is_feasible)
    assert 0.2 < inside.mean() < 0.8
    assert turned(got.pose.R, tip.R)[inside].max() < 1e-5
    assert turned(got.pose.R, tip.R)[~inside].min() > 1e-5
    twice = through(got.pose, p)
    assert turned(twice.pose.R, got.pose.R).max() < 1e-5
    assert apart(twice.pose.p, got.pose.p).max() < 1e-6


def test_no_other_turn_about_the_line_is_nearer(rng, p_world_ref):
    _, p = trocars(2000, p_world_ref)
    tip = board_poses(rng, 2000)
    got = through(tip, p)
    line = (got.pose.p - p) / np.linalg.norm(got.pose.p - p, axis=-1, keepdims=True)
    nearest = turned(got.pose.R, tip.R)
    for angle in (-1.0, -0.01, 0.01, 1.0, np.pi):
        turn = transform.Rotation.from_rotvec(angle * line).as_matrix()
        assert (turned(turn @ got.pose.R, tip.R) >= nearest - 1e-5).all()


def test_no_other_posture_is_much_nearer(p_world_ref):
    """Against a search of the limits' edges and all rolls, for rotations outside the limits."""
    rng, n = np.random.default_rng(1), 400
    tip = board_poses(rng, n)
    got = through(tip, p_world_ref)
    edge, limit = np.linspace(-LIMIT, LIMIT, 25), np.full(25, LIMIT)
    sides = [(edge, limit), (edge, -limit), (limit, edge), (-limit, edge)]
    angles = np.concatenate([np.stack(side, -1) for side in sides])
    roll = np.linspace(-np.pi, np.pi, 120, endpoint=False)
    postures = np.concatenate(
        [np.repeat(roll, len(angles))[:, None], np.tile(angles, (len(roll), 1))], -1
    )

    @jax.jit
    def search(R, p):
        action = jnp.concatenate([postures, jnp.broadcast_to(p, (len(postures), 3))], -1)
        pose, _ = SPACE.decode(action, rcm.Trocar(0.0, np.pi / 2, 0.0), p_world_ref)
        return jnp.max(jnp.einsum("nij,ij->n", pose.R, R))  # trace: cosine of the angle

    cos = (np.array([search(R, p) for R, p in zip(*tip)]) - 1.0) / 2.0
    best = np.rad2deg(np.arccos(np.clip(cos, -1.0, 1.0)))
    excess = np.rad2deg(turned(got.pose.R, tip.R)) - best
    outside = ~np.asarray(got.is_feasible)
    near = outside & (best < 10.0)
    assert near.sum() > 10 and excess[near].max() < 0.5
    assert np.median(excess[outside]) < 2.0 and excess[outside].max() < 22.0


def test_a_tip_too_near_the_trocar_or_too_far_is_moved_along_the_line(p_world_ref):
    down = np.float32([0, 0, -1])
    R = np.diag([1.0, -1.0, -1.0]).astype(np.float32)
    for depth in (0.0, 0.01, 0.5, 1e20):
        got = through(rcm.Pose(R, p_world_ref + depth * down), p_world_ref)
        least = WRIST.clevis + WRIST.jaws + rcm.MIN_DEPTH
        expected = np.clip(depth, least, rcm.MAX_DEPTH)
        np.testing.assert_allclose(got.pose.p, p_world_ref + expected * down, atol=1e-6)
        assert not got.is_feasible


def test_half_a_turn_of_the_roll_turns_the_jaws_by_half(rng, p_world_ref):
    shaft, angles = shafts(rng, 100, p_world_ref), angles_of(rng, 100)
    half = np.diag([-1.0, -1.0, 1.0]).astype(np.float32)
    tip = forward(shaft, angles)
    other = forward(shaft._replace(R=shaft.R @ half), -angles)
    np.testing.assert_allclose(other.R, tip.R @ half, atol=1e-6)
    np.testing.assert_allclose(other.p, tip.p, atol=1e-7)


@pytest.mark.slow
def test_rcm6_is_written_and_read(rng, p_world_ref):
    trocar, p = trocars(N, p_world_ref)
    tip = forward(shafts(rng, N, p), angles_of(rng, N))
    action = jax.jit(SPACE.encode)(tip, trocar, p_world_ref)
    pose, valid = jax.jit(SPACE.decode)(action, trocar, p_world_ref)
    assert valid.all()
    assert apart(pose.p, tip.p).max() < 1e-6 and turned(pose.R, tip.R).max() < 1e-5
    frame = rcm.trocar_frame(trocar, p_world_ref, np.pi)
    action = jax.jit(SPACE.encode)(tip, frame)
    pose, _ = jax.jit(SPACE.decode)(action, frame)
    assert apart(pose.p, tip.p).max() < 1e-6 and turned(pose.R, tip.R).max() < 1e-5


def test_rcm6_keeps_tip_roll_and_angles_of_any_action(rng, p_world_ref):
    trocar, p = trocars(N, p_world_ref)
    action = np.concatenate(
        [
            rng.uniform(-np.pi, np.pi, (N, 1)),
            rng.uniform(-1.5, 1.5, (N, 2)),
            board_poses(rng, N).p,
        ],
        axis=-1,
    ).astype(np.float32)
    pose, _ = jax.jit(SPACE.decode)(action, trocar, p_world_ref)
    angles, shaft = back(pose, p)
    assert apart(pose.p, action[:, SPACE.slices["p"]]).max() < 1e-6
    clipped = np.clip(action[:, SPACE.slices["wrist"]], -LIMIT, LIMIT)
    assert np.abs(angles - clipped).max() < 1e-5
    roll = rcm.roll_of(shaft.R) - action[:, 0]
    assert np.abs(np.arctan2(np.sin(roll), np.cos(roll))).max() < 1e-5


def test_rcm6_without_a_bend_is_rcm4(rng, oracle, p_world_ref):
    trocar, p = trocars(N, p_world_ref)
    straight = rcm.ACTION_SPACES["rcm4"]
    action = oracle.hostile_actions(rng, straight, p)
    pose, valid = jax.jit(straight.decode)(action, trocar, p_world_ref)

    def six(wrist):
        bent = np.insert(action, [1, 1], 0.0, axis=-1)
        return jax.jit(rcm.rcm6(wrist).decode)(bent, trocar, p_world_ref)

    rigid, rigid_valid = six(rcm.Wrist(0.0, 0.0, 0.0, 0.0))
    np.testing.assert_array_equal(rigid_valid, valid)
    assert apart(rigid.p, pose.p).max() < 1e-6 and turned(rigid.R, pose.R).max() < 1e-5
    deep = apart(pose.p, p) > WRIST.clevis + WRIST.jaws + rcm.MIN_DEPTH
    zero, _ = six(WRIST)
    assert deep.mean() > 0.3 and apart(zero.p, pose.p)[deep].max() < 1e-6
    assert turned(zero.R, pose.R)[deep].max() < 1e-5


def test_rcm6_is_total(rng, oracle, p_world_ref):
    trocar, p = trocars(N, p_world_ref)
    action = oracle.hostile_actions(rng, SPACE, p)
    pose, valid = jax.jit(SPACE.decode)(action, trocar, p_world_ref)
    assert np.isfinite(pose.R).all() and np.isfinite(pose.p).all()
    oracle.check_rotations(pose.R)
    np.testing.assert_array_equal(valid, np.isfinite(action).all(-1))
    angles, shaft = back(pose, p)
    assert rcm.rcm_error(shaft, p).max() < 1e-6
    assert np.abs(angles).max() < LIMIT + 1e-4


def hostile_poses(rng, oracle, n, p_world_trocar):
    """Poses and trocars of any bits, and tips at the trocar or on a line through it."""
    R, p = oracle.hostile(rng, (n, 3, 3)), oracle.hostile(rng, (n, 3))
    near = 10.0 ** rng.uniform(-45, -1, (n, 3)) * rng.choice([-1, 0, 1], (n, 3))
    p = np.where(rng.random((n, 1)) < 0.5, p_world_trocar + near, p).astype(np.float32)
    rotation = rcm.rot6d_decode(oracle.hostile(rng, (n, 6)))
    return rcm.Pose(np.where(rng.random((n, 1, 1)) < 0.7, rotation, R).astype(np.float32), p)


def test_maps_are_total(rng, oracle, p_world_ref):
    tip = hostile_poses(rng, oracle, N, p_world_ref)
    got = through(tip, p_world_ref)
    finite = np.isfinite(tip.R).all((-2, -1)) & np.isfinite(tip.p).all(-1)
    for leaf in (got.pose.R, got.pose.p, got.wrist, rcm.angles_through(WRIST, tip, p_world_ref)):
        assert (np.isfinite(leaf).reshape(N, -1).all(-1) == finite).all()
        assert np.isnan(np.asarray(leaf)[~finite]).all()
    oracle.check_rotations(np.asarray(got.pose.R)[finite])
    assert not got.is_feasible[~finite].any()


@pytest.mark.slow
def test_derivatives_are_finite(rng, oracle, p_world_ref):
    n = 5000
    trocar, p = trocars(n, p_world_ref)
    tip = hostile_poses(rng, oracle, n, p)
    tip = jax.tree.map(lambda x: np.where(np.isfinite(x), x, 0.0), tip)
    action = oracle.hostile_actions(rng, SPACE, p)
    weights = rng.normal(size=14).astype(np.float32)

    def weighted(pose, angles):
        return jnp.concatenate([pose.R.ravel(), pose.p, angles]) @ weights

    def near(tip, p):
        return weighted(*rcm.through(WRIST, tip, p)[:2])

    def straight(tip, p):
        tip = tip._replace(R=rcm.rot6d_decode(rcm.rot6d_encode(tip.R)))
        angles = rcm.angles_through(WRIST, tip, p)
        return weighted(rcm.shaft_of(WRIST, tip, angles), angles)

    def decoded(action, trocar):
        return weighted(SPACE.decode(action, trocar, p_world_ref)[0], jnp.zeros(2))

    @jax.jit
    @jax.vmap
    def derivatives(tip, p, action, trocar):
        maps = [jax.grad(f, (0, 1))(tip, p) for f in (near, straight)]
        return maps, jax.grad(decoded, (0, 1))(action, trocar), jax.jacfwd(near)(tip, p)

    for leaf in jax.tree.leaves(derivatives(tip, p, action, trocar)):
        assert np.isfinite(leaf).all()


def test_single_samples_and_batches_broadcast(rng, p_world_ref):
    shaft, angles = shafts(rng, 4, p_world_ref), angles_of(rng, 4)
    tips = rcm.tip_of(WRIST, shaft, angles)
    for i in range(4):
        one = rcm.tip_of(WRIST, jax.tree.map(lambda x: x[i], shaft), angles[i])  # noqa: B023
        np.testing.assert_allclose(one.p, tips.p[i], atol=1e-7)
    grid = rcm.tip_of(WRIST, jax.tree.map(lambda x: x[:, None], shaft), angles)
    assert grid.R.shape == (4, 4, 3, 3) and grid.p.shape == (4, 4, 3)
    got = rcm.through(WRIST, jax.tree.map(lambda x: x[:, None], tips), p_world_ref[None])
    assert got.pose.R.shape == (4, 1, 3, 3) and got.wrist.shape == (4, 1, 2)
    assert got.is_feasible.shape == (4, 1)
    with pytest.raises(ValueError, match="angles"):
        rcm.tip_of(WRIST, shaft, np.zeros(3))


def test_what_is_no_rotation_and_a_tip_above_the_trocar_are_not_feasible(rng, p_world_ref):
    o = np.float32(p_world_ref)
    good = rcm.Pose(np.float32(np.diag([1, -1, -1])), o - np.float32([0, 0, 0.1]))
    assert rcm.through(WRIST, good, o).is_feasible
    for R in (2.0 * good.R, good.R * [[-1.0, 1.0, 1.0]]):
        assert not rcm.through(WRIST, good._replace(R=np.float32(R)), o).is_feasible
    above = rcm.Pose(np.eye(3, dtype=np.float32), o + np.float32([0, 0, 0.05]))
    assert not rcm.through(WRIST, above, o).is_feasible
