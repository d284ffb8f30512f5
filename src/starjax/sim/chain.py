"""Reads a serial arm off a compiled model: a chain of hinges and slides."""

from collections.abc import Sequence

import mujoco
import numpy as np
from jax.typing import ArrayLike

from starjax.core import errors
from starjax.sim.ik import Chain


def chain_of(m: mujoco.MjModel, first: str, site: str, joints: tuple[str, ...] = ()) -> Chain:
    """Reads the chain from body `first` down to `site` off a compiled model.

    Any axis, anchor, reference and number of joints a body will do; bodies without a joint are
    merged.

    Args:
      joints: expected names from `first` to the site; empty: any.

    Raises:
      errors.UsageError: `first` is not above the site, or a joint above it would move it; a joint
        on the way is neither hinge nor slide, or another than expected.
    """
    path = _path(m, first, site)
    data = mujoco.MjData(m)  # the base's pose in the zero configuration
    mujoco.mj_kinematics(m, data)
    root = int(m.body_parentid[path[0]])
    on_way = [j for body in path for j in _joints(m, body)]
    _check(m, first, on_way, joints)
    # Fixed bodies fold into the transform to the next joint.
    p, R = np.zeros(3), np.eye(3)  # from the last joint on
    offsets, rotations = [], []
    for body in path:
        p, R = p + R @ m.body_pos[body], R @ _matrix(m.body_quat[body])
        for j in _joints(m, body):
            # qpos0: angle of the drawn pose
            to_axis, zero = _from_z(m.jnt_axis[j]), -m.qpos0[m.jnt_qposadr[j]]
            is_hinge = m.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE
            # A hinge turns about its anchor; a slide starts at -qpos0 along its axis.
            anchor = m.jnt_pos[j] if is_hinge else zero * m.jnt_axis[j]
            offsets.append(p + R @ anchor)
            rotations.append(R @ to_axis @ _about_z(zero) if is_hinge else R @ to_axis)
            # Back to the body's frame
            p, R = (-to_axis.T @ anchor if is_hinge else np.zeros(3)), to_axis.T
    return Chain(
        p_base=_float32(data.xpos[root]),
        R_base=_float32(data.xmat[root].reshape(3, 3)),
        offsets=_float32(offsets),
        rotations=_float32(rotations),
        p_tip=_float32(p + R @ m.site(site).pos),
        R_tip=_float32(R @ _matrix(m.site(site).quat)),
        limits=_float32([_limits(m, j) for j in on_way]),
        slides=tuple(bool(m.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE) for j in on_way),
    )


def _path(m: mujoco.MjModel, first: str, site: str) -> list[int]:
    """Returns the bodies from `first` down to the site's."""
    path = [int(m.site(site).bodyid[0])]
    while m.body(path[-1]).name != first:
        if not path[-1]:  # the world, which is its own parent
            raise errors.UsageError("first", f"a body above the site {site}", repr(first))
        path.append(int(m.body_parentid[path[-1]]))
    return path[::-1]


def _check(m: mujoco.MjModel, first: str, on_way: list[int], joints: tuple[str, ...]) -> None:
    """Refuses a chain that these kinematics would get wrong."""
    above = int(m.body_parentid[m.body(first).id])
    while above:
        if m.body_jntnum[above]:
            raise errors.UsageError("first", "a body that no joint above moves", repr(first))
        above = int(m.body_parentid[above])
    names = tuple(m.joint(j).name for j in on_way)
    if not names:
        raise errors.UsageError("first", "a body with a joint, in it or below", repr(first))
    for j, name in zip(on_way, names):
        kind = mujoco.mjtJoint(m.jnt_type[j])
        if kind not in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
            raise errors.UsageError(f"joint {name}", "a hinge or a slide", _kind(kind))
    if joints and names != tuple(joints):
        raise errors.UsageError("joints", " ".join(names), " ".join(joints))


def _kind(kind: mujoco.mjtJoint) -> str:
    return "a ball" if kind == mujoco.mjtJoint.mjJNT_BALL else "a free joint"


def _joints(m: mujoco.MjModel, body: int) -> range:
    start = int(m.body_jntadr[body])
    return range(start, start + int(m.body_jntnum[body]))


def _limits(m: mujoco.MjModel, j: int) -> np.ndarray:
    return m.jnt_range[j] if m.jnt_limited[j] else np.array([-np.inf, np.inf])


def _from_z(axis: np.ndarray) -> np.ndarray:
    """Returns a rotation that takes z to the unit vector `axis`."""
    wxyz = np.zeros(4)
    mujoco.mju_quatZ2Vec(wxyz, axis)
    return _matrix(wxyz)


def _about_z(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _float32(x: ArrayLike | Sequence[np.ndarray]) -> np.ndarray:
    return np.asarray(x, np.float32)


def _matrix(wxyz: np.ndarray) -> np.ndarray:
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, np.asarray(wxyz, np.float64))
    return out.reshape(3, 3)
