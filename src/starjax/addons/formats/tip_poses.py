"""Poses of an arm in the task's world, from the columns of another dataset."""

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from scipy.spatial import transform

from starjax import rcm
from starjax.addons.formats import mapping as maps
from starjax.addons.formats.mapping import ArmColumns, Columns, Map, Quaternion, Vector
from starjax.core import errors
from starjax.data import shafts

INSTRUMENTS = {"large_needle_driver": rcm.LARGE_NEEDLE_DRIVER, "prograsp": rcm.PROGRASP}
_TINY = 1e-6  # kg and kg m^2 of a model's bodies, at least
_TURNS, _FAR = 4.0 * np.pi, 5.0  # rad and m, beyond which no joint without limits goes
_UNIT = 0.1  # by which a quaternion's length may be off


class TipPoses(NamedTuple):
    """Tip poses on the host: rotations `[..., 3, 3]`, positions `[..., 3]` m."""

    R: np.ndarray
    p: np.ndarray


class JointLimits(NamedTuple):
    """Limits of a joint, in rad if it turns, otherwise in m."""

    name: str
    turns: bool
    low: float
    high: float


Arrays = Mapping[str, np.ndarray]


def tip(arrays: Arrays, arm: ArmColumns, mapping: Map, folder: Path) -> TipPoses:
    """Returns the measured poses of the tip `[T]`."""
    offset = arm.tip, arm.tip_turn
    if arm.joints:
        return _of_joints(arrays, arm, arm.body, offset, mapping, folder)
    return _of_columns(arrays, arm, (arm.position, arm.rotation), offset, mapping)


def command(arrays: Arrays, arm: ArmColumns, mapping: Map) -> TipPoses | None:
    """Returns the commanded poses of the tip `[T]`, None if the files lack them."""
    if not (arm.command_position and arm.command_rotation):
        return None
    kind = arm.command_rotation_as
    kind = arm.rotation_as if isinstance(kind, msgspec.UnsetType) else kind
    R, p = _raw(arrays, arm.command_position, arm.command_rotation, kind)
    if arm.command_as == "delta":
        R_now, p_now = _raw(arrays, arm.position, arm.rotation, arm.rotation_as)
        R, p = R @ R_now, p_now + p
    return _in_world(R, p, (arm.tip, arm.tip_turn), mapping)


def shaft(
    arrays: Arrays, arm: ArmColumns, mapping: Map, folder: Path, measured: TipPoses
) -> TipPoses:
    """Returns the poses of the shaft `[T]`: those of the measured tip for a straight tool."""
    columns = arm.shaft
    if not isinstance(columns, maps.ShaftColumns):
        return measured
    if columns.instrument:
        angles = maps.pick(arrays, columns.angles, 2)
        if (largest := float(np.abs(angles).max(initial=0.0))) > np.pi:
            raise errors.UsageError("angles", "pitch and yaw in rad, at most pi", f"{largest:.3g}")
        found = shafts.of_wrist(*measured, INSTRUMENTS[columns.instrument], angles)
        return TipPoses(np.asarray(found.R), np.asarray(found.p))
    offset = (0.0, 0.0, 0.0), columns.turn
    if columns.body:
        return _of_joints(arrays, arm, columns.body, offset, mapping, folder)
    return _of_columns(arrays, arm, (columns.position, columns.rotation), offset, mapping)


def placed(p: np.ndarray, mapping: Map) -> np.ndarray:
    """Returns positions `[..., 3]` of the files in m of the task's world."""
    scale = 1e-3 if mapping.units == "mm" else 1.0
    return np.array(mapping.origin) + scale * p @ _quaternion(mapping.turn, "turn").T


def _of_columns(
    arrays: Arrays,
    arm: ArmColumns,
    columns: tuple[Columns, Columns],
    offset: tuple[Vector, Quaternion],
    mapping: Map,
) -> TipPoses:
    R, p = _raw(arrays, *columns, arm.rotation_as)
    return _in_world(R, p, offset, mapping)


def _raw(
    arrays: Arrays, position: Columns, rotation: Columns, kind: maps.Turned
) -> tuple[np.ndarray, np.ndarray]:
    """Returns rotations `[T, 3, 3]` and positions `[T, 3]` in the files' frame and unit."""
    numbers = maps.pick(arrays, rotation, maps.NUMBERS[kind])
    return rotations(numbers, kind), maps.pick(arrays, position, 3)


def _in_world(
    R: np.ndarray, p: np.ndarray, offset: tuple[Vector, Quaternion], mapping: Map
) -> TipPoses:
    return _moved(_quaternion(mapping.turn, "turn") @ R, placed(p, mapping), offset)


def _of_joints(
    arrays: Arrays,
    arm: ArmColumns,
    frame: str,
    offset: tuple[Vector, Quaternion],
    mapping: Map,
    folder: Path,
) -> TipPoses:
    joints = maps.pick(arrays, arm.joints)
    R, p = _kinematics(joints, arm, frame, folder / arm.model)
    turn = _quaternion(mapping.turn, "turn")
    # A model is in m whatever the columns are.
    return _moved(turn @ R, np.array(mapping.origin) + p @ turn.T, offset)


def _moved(R: np.ndarray, p: np.ndarray, offset: tuple[Vector, Quaternion]) -> TipPoses:
    position, turn = offset
    return TipPoses(R @ _quaternion(turn, "tip_turn"), p + R @ np.array(position))


def rotations(numbers: np.ndarray, kind: maps.Turned) -> np.ndarray:
    """Converts rotations of any notation to matrices `[T, 3, 3]`."""
    if kind.startswith("quat"):
        length = np.linalg.norm(numbers, axis=-1)
        off = np.abs(length - 1.0) > _UNIT
        if off.any():
            got = f"one of length {length[off][0]:.3g} at step {int(np.argmax(off))}"
            raise errors.UsageError("rotation", "unit quaternions", got)
        xyzw = numbers if kind == "quat_xyzw" else numbers[:, [1, 2, 3, 0]]
        return transform.Rotation.from_quat(xyzw).as_matrix()
    if kind in ("rotvec", "euler_xyz") and (most := float(np.abs(numbers).max())) > _TURNS:
        raise errors.UsageError("rotation", "angles in rad", f"{most:.4g}: are they degrees?")
    if kind == "rotvec":
        return transform.Rotation.from_rotvec(numbers).as_matrix()
    if kind == "euler_xyz":
        return transform.Rotation.from_euler("xyz", numbers).as_matrix()
    columns = numbers[:, [0, 3, 6, 1, 4, 7]] if kind == "matrix" else numbers
    x, y = columns[:, :3], columns[:, 3:]
    off = np.abs([np.sum(x * x, -1) - 1.0, np.sum(y * y, -1) - 1.0, np.sum(x * y, -1)]).max(0)
    if (off > _UNIT).any():
        got = f"columns off by {off.max():.3g} at step {int(np.argmax(off))}"
        raise errors.UsageError("rotation", "orthonormal columns", got)
    whole = np.stack([x, y, np.cross(x, y)], -1)
    if kind == "matrix" and np.abs(whole[:, :, 2] - numbers[:, [2, 5, 8]]).max() > _UNIT:
        raise errors.UsageError("rotation", "matrices of rotations", "a mirrored one")
    return transform.Rotation.from_matrix(whole).as_matrix()


def _quaternion(wxyz: tuple[float, ...], name: str) -> np.ndarray:
    length = float(np.linalg.norm(wxyz))
    if not abs(length - 1.0) <= _UNIT:
        raise errors.UsageError(name, "a unit quaternion, wxyz", list(wxyz))
    w, x, y, z = wxyz
    return transform.Rotation.from_quat([x, y, z, w]).as_matrix()


def _kinematics(
    joints: np.ndarray, arm: ArmColumns, frame: str, path: Path
) -> tuple[np.ndarray, np.ndarray]:
    """Returns `[T, 3, 3]` and `[T, 3]` of `frame` in the model's world."""
    import mujoco

    model, places, site, body = _model(path, arm.joint_names, frame, joints.shape[1])
    data = mujoco.MjData(model)
    R, p = np.zeros((len(joints), 3, 3)), np.zeros((len(joints), 3))
    for t, row in enumerate(joints):
        data.qpos[places] = row
        mujoco.mj_kinematics(model, data)
        end = data.site(site) if site >= 0 else data.body(body)
        R[t], p[t] = end.xmat.reshape(3, 3), end.xpos
    return R, p


def unmoved(arrays: Arrays, arm: ArmColumns, folder: Path) -> list[str]:
    """Returns the joints between a model's base and the arm's tip that no column gives."""
    count = maps.pick(arrays, arm.joints).shape[1]
    model, places, site, body = _model(folder / arm.model, arm.joint_names, arm.body, count)
    body, found = model.site_bodyid[site] if site >= 0 else body, []
    while body:
        first = model.body_jntadr[body]
        found += [model.joint(i) for i in range(first, first + model.body_jntnum[body])]
        body = model.body_parentid[body]
    return [joint.name for joint in found if joint.qposadr[0] not in places]


def joint_names(path: Path) -> list[str]:
    """Returns the names of a model's joints."""
    model = _loaded(path)
    return [model.joint(i).name for i in range(model.njnt)]


def limits(arm: ArmColumns, folder: Path, count: int) -> list[JointLimits]:
    """Returns the limits of the joints of an arm's columns."""
    import mujoco

    path = folder / arm.model
    model, names = _loaded(path), arm.joint_names or joint_names(path)[:count]
    rows = []
    for name in names:
        joint = model.joint(name)
        turns = int(joint.type[0]) == mujoco.mjtJoint.mjJNT_HINGE
        most = _TURNS if turns else _FAR
        low, high = joint.range if model.jnt_limited[joint.id] else (-most, most)
        rows.append(JointLimits(name, turns, float(low), float(high)))
    return rows


@functools.cache
def _loaded(path: Path) -> Any:
    """Loads a robot's model."""
    import mujoco

    try:
        spec = mujoco.MjSpec.from_file(str(path))
        # Kinematics alone: links at fixed joints stay, masses and inertias are of no account.
        spec.compiler.fusestatic, spec.compiler.balanceinertia = False, True
        spec.compiler.boundmass = spec.compiler.boundinertia = _TINY
        return spec.compile()
    except ValueError as error:
        raise errors.UsageError("model", "an MJCF or URDF", f"{path}: {error}") from error


@functools.cache
def _model(path: Path, joints: tuple[str, ...], tip: str, count: int) -> tuple:
    """Returns a robot's model, its joints' addresses, and the id of the tip's site or body."""
    import mujoco

    model, known = _loaded(path), joint_names(path)
    for name in joints:
        errors.choice("joint_names", name, known)
    chosen = joints or tuple(known[:count])
    if len(chosen) != count:
        raise errors.UsageError("joints", f"{len(chosen)} as in the model", count)
    find = functools.partial(mujoco.mj_name2id, model)
    site, body = (find(kind, tip) for kind in (mujoco.mjtObj.mjOBJ_SITE, mujoco.mjtObj.mjOBJ_BODY))
    if max(site, body) < 0:
        bodies = [model.body(i).name for i in range(model.nbody)]
        errors.choice("body", tip, bodies + [model.site(i).name for i in range(model.nsite)])
    places = [model.jnt_qposadr[known.index(name)] for name in chosen]
    return model, np.array(places), site, body
