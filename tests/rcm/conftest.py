"""Inputs that break rotation code, and a float64 numpy oracle written straight from the paper."""

import types

import numpy as np
import pytest

P_WORLD_REF = np.array([0.01, -0.02, 0.15], np.float32)
DOWN = np.diag([1.0, -1.0, -1.0])


@pytest.fixture(scope="session")
def p_world_ref():
    return P_WORLD_REF


def hostile(rng, shape):
    """float32 numbers of every kind: any bit pattern, and the values that sit on branches."""
    bits = rng.integers(0, 2**32, shape, np.uint32).view(np.float32)
    near_zero = [0, -0.0, 1e-45, -1e-45, 1e-38, 1e-7, -5e-7, 5.1e-7, 1e-6, 1e-4]
    ordinary = [0.005, 0.15, 0.4, 1, -1, np.pi, -np.pi, 2 * np.pi]
    huge = [1e4, 1e20, -1e20, 1e30, 1e38, -1e38, 3.4e38, -3.4e38, np.inf, -np.inf, np.nan]
    special = np.array([*near_zero, *ordinary, *huge], np.float32)
    kind = rng.random(shape)
    normal = rng.normal(size=shape).astype(np.float32)
    return np.where(kind < 0.3, bits, np.where(kind < 0.7, rng.choice(special, shape), normal))


def hostile_actions(rng, space, p_world_trocar):
    """One action a trocar: a quarter ordinary, a quarter hostile, half at or about the trocar.

    The last half has its position at the trocar, exactly above or below it, or 1e-45 to 1e-3 m
    off that line, or its 6-D columns zero, parallel or nearly so.
    """
    n = len(p_world_trocar)
    action = rng.normal(scale=0.3, size=(n, space.dim)).astype(np.float32)
    quarter = slice(n // 4, n // 2)
    action[quarter] = hostile(rng, action[quarter].shape)
    half = slice(n // 2, n)
    size = n - n // 2
    near = 10.0 ** rng.uniform(-45, -3, (size, 3)) * rng.choice([-1, 0, 1], (size, 3))
    if "p" in space.slices:
        near[:, 2] += rng.choice([0, 0.1, -0.1, 0.3, -0.3], size)
        origin = 0.0 if space.name == "rcm2" else p_world_trocar[half]
        action[half, space.slices["p"]] = origin + near
    if "R" in space.slices:
        x = rng.normal(size=(size, 3)) * rng.choice([0, 1e-45, 1e-6, 1, 1e30], (size, 1))
        y = x * rng.choice([0, -1, 1, 1e-3], (size, 1)) + near
        action[half, space.slices["R"]] = np.concatenate([x, y], axis=-1).clip(-3e38, 3e38)
    return action


def unit(rng, n):
    v = rng.normal(size=(n, 3))
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def align(a, b):
    """Eq. 16 verbatim."""
    k = np.cross(a, b)
    K = np.cross(k[..., None, :], np.eye(3)).swapaxes(-1, -2)
    factor = 1.0 / (1.0 + np.sum(a * b, axis=-1))
    return np.eye(3) + K + K @ K * factor[..., None, None]


def rotation_z(angle):
    c, s, o = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    return np.stack([c, -s, o, s, c, o, o, o, o + 1], axis=-1).reshape(*np.shape(angle), 3, 3)


def trocar_position(trocar, p_world_ref):
    """Eq. 2."""
    r, theta, phi = (np.asarray(field, np.float64) for field in trocar)
    sin = np.sin(theta)
    direction = np.stack([sin * np.cos(phi), sin * np.sin(phi), np.cos(theta)], axis=-1)
    return np.asarray(p_world_ref, np.float64) + r[..., None] * direction


def trocar_rotation(trocar):
    """z down, x along the azimuth, y = z cross x."""
    phi = np.asarray(trocar.azimuth, np.float64)
    x = np.stack([np.cos(phi), np.sin(phi), np.zeros_like(phi)], axis=-1)
    z = np.broadcast_to([0.0, 0.0, -1.0], x.shape)
    return np.stack([x, np.cross(z, x), z], axis=-1)


def gram_schmidt(rot6d):
    x = rot6d[..., :3] / np.linalg.norm(rot6d[..., :3], axis=-1, keepdims=True)
    y = rot6d[..., 3:] - np.sum(x * rot6d[..., 3:], axis=-1, keepdims=True) * x
    y = y / np.linalg.norm(y, axis=-1, keepdims=True)
    return np.stack([x, y, np.cross(x, y)], axis=-1)


def decode(name, action, trocar, p_world_ref):
    """Eq. 5 and Alg. 1 for well-behaved actions, without any clamp: (R, p) in float64."""
    action = np.asarray(action, np.float64)
    p_trocar, R_trocar = trocar_position(trocar, p_world_ref), trocar_rotation(trocar)
    if name.endswith("_fixed_yaw"):
        name, R_trocar = name.removesuffix("_fixed_yaw"), np.broadcast_to(DOWN, R_trocar.shape)
    if name == "se3":
        return gram_schmidt(action[..., 3:]), action[..., :3]
    if name in ("rcm1", "rcm3"):
        R = gram_schmidt(action[..., 1:])
        R = R_trocar @ R if name == "rcm1" else R
        return R, p_trocar + action[..., :1] * R[..., :, 2]
    assert name in ("rcm2", "rcm4"), f"no formula for {name}"
    p = action[..., 1:]
    p = p_trocar + np.einsum("...ij,...j->...i", R_trocar, p) if name == "rcm2" else p
    axis = (p - p_trocar) / np.linalg.norm(p - p_trocar, axis=-1, keepdims=True)
    e_z = np.broadcast_to([0.0, 0.0, 1.0], axis.shape)
    return DOWN @ align(e_z, axis @ DOWN) @ rotation_z(action[..., 0]), p


def rcm_error(R, p, p_world_trocar):
    """Eq. 3: distance of the trocar from the shaft's line, in m, in float64."""
    R, p = np.asarray(R, np.float64), np.asarray(p, np.float64)
    return np.linalg.norm(np.cross(p - p_world_trocar, R[..., :, 2]), axis=-1)


def check_rotations(R, atol=1e-5):
    R = np.asarray(R, np.float64)
    gram = np.einsum("...ji,...jk->...ik", R, R)
    assert np.abs(gram - np.eye(3)).max() <= atol
    det = np.einsum("...i,...i->...", R[..., 0], np.cross(R[..., 1], R[..., 2]))
    assert det.min() > 0


@pytest.fixture(scope="session")
def oracle():
    """The functions above, for test files: pytest imports this file under no fixed name."""
    return types.SimpleNamespace(
        align=align,
        check_rotations=check_rotations,
        decode=decode,
        hostile=hostile,
        hostile_actions=hostile_actions,
        rcm_error=rcm_error,
        rotation_z=rotation_z,
        trocar_position=trocar_position,
        trocar_rotation=trocar_rotation,
        unit=unit,
    )
