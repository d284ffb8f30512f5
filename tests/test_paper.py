"""Table I of the paper as properties: the parts of an action that change with the trocar."""

import jax
import numpy as np
import pytest

from starjax import rcm

P_WORLD_REF = np.array([0.0, 0.0, 0.15], np.float32)
# Table I, row "trocar-invariant component".
INVARIANT = {"rcm1": set(), "rcm2": set(), "rcm3": {"R"}, "rcm4": {"p"}}
# With one yaw for every trocar the first two no longer differ from the third.
INVARIANT |= {"rcm1_fixed_yaw": {"R"}, "rcm2_fixed_yaw": {"R"}}
TABLE_I = pytest.mark.parametrize(("name", "invariant"), INVARIANT.items(), ids=INVARIANT.keys())


@pytest.fixture(scope="module")
def actions():
    """Laparoscopic targets: tips on and above the board, any roll, one action per space."""
    rng = np.random.default_rng(0)
    n = 200
    p = rng.uniform([-0.06, -0.06, 0.0], [0.06, 0.06, 0.05], (n, 3)).astype(np.float32)
    tilt = rng.normal(scale=0.2, size=(n, 2))
    axis = np.concatenate([tilt, -np.ones((n, 1))], axis=-1).astype(np.float32)
    roll = rng.uniform(-1.5, 1.5, n).astype(np.float32)
    rot6d = np.asarray(rcm.rot6d_encode(rcm.rotation_from_axis_roll(axis, roll)))
    depth = rng.uniform(0.08, 0.2, (n, 1)).astype(np.float32)
    relative_R = np.concatenate([depth, rot6d * [1, -1, -1, 1, -1, -1]], axis=-1)
    relative_p = np.concatenate([roll[:, None], (p - P_WORLD_REF) * [1, -1, -1]], axis=-1)
    return {
        "rcm1": relative_R,
        "rcm2": relative_p,
        "rcm1_fixed_yaw": relative_R,
        "rcm2_fixed_yaw": relative_p,
        "rcm3": np.concatenate([depth, rot6d], axis=-1),
        "rcm4": np.concatenate([roll[:, None], p], axis=-1),
    }


def decode_everywhere(space, action):
    """Poses `[12, n]` of the same actions at each of the twelve trocars."""
    trocar = jax.tree.map(lambda field: field[:, None], rcm.TROCARS)
    pose, valid = jax.jit(space.decode)(action.astype(np.float32), trocar, P_WORLD_REF)
    assert valid.all()
    return jax.tree.map(np.asarray, pose)


def spread(values):
    """Largest difference over the trocars, smallest and largest over the samples."""
    by_sample = np.ptp(values, axis=0).reshape(values.shape[1], -1).max(axis=-1)
    return by_sample.min(), by_sample.max()


@TABLE_I
def test_invariant_component(name, invariant, actions):
    """The same action at twelve trocars: the invariant part of the pose stays, the rest moves."""
    pose = decode_everywhere(rcm.ACTION_SPACES[name], actions[name])
    for part, still, moved in (("R", 1e-6, 0.05), ("p", 1e-6, 0.01)):
        least, most = spread(getattr(pose, part))
        if part in invariant:
            assert most < still
        else:
            assert least > moved


@TABLE_I
def test_invariant_component_of_the_action(name, invariant, actions):
    """A tip position (or a rotation) of the task is the same number at every trocar
    in the absolute space, and another one in the relative space (Theorem 1)."""
    space = rcm.ACTION_SPACES[name]
    source = decode_everywhere(
        rcm.ACTION_SPACES["rcm4" if "p" in space.slices else "rcm3"],
        actions["rcm4" if "p" in space.slices else "rcm3"],
    )
    trocar = jax.tree.map(lambda field: field[:, None], rcm.TROCARS)
    action = np.asarray(jax.jit(space.encode)(source, trocar, P_WORLD_REF))
    part = "p" if "p" in space.slices else "R"
    least, most = spread(action[..., space.slices[part]])
    if part in invariant:
        assert most < 1e-6
    else:
        assert least > 0.01


def test_configuration_consistency(actions):
    """Row "configuration consistency": with the absolute part held and the trocar moved by
    centimetres, rcm4 leaves the tip and turns the tool a little (good); rcm3 leaves the rotation
    and carries the tip along with the trocar (poor)."""
    moved = rcm.trocar_position(rcm.TROCARS, P_WORLD_REF)
    span = np.linalg.norm(moved[:, None] - moved[None], axis=-1).max()
    tips = {}
    for name in ("rcm3", "rcm4"):
        p = decode_everywhere(rcm.ACTION_SPACES[name], actions[name]).p
        tips[name] = np.linalg.norm(p[:, None] - p[None], axis=-1).max(axis=(0, 1))
    np.testing.assert_allclose(tips["rcm3"], span, atol=1e-6)
    assert tips["rcm4"].max() < 1e-6


def test_relative_differs_from_absolute_by_more_than_a_constant(actions):
    """The reason for an azimuth-turned {T}: with a fixed yaw, rcm1 and rcm3 would be the same
    up to a constant rotation."""
    pose = decode_everywhere(rcm.ACTION_SPACES["rcm1"], actions["rcm1"])
    relative = np.einsum("tnij,nkj->tnik", pose.R, pose.R[0])
    assert np.ptp(relative, axis=0).max() > 1.0
