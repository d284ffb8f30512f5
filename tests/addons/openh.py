"""Datasets shaped as those of Open-H, of invented motions: straight tools and wristed ones."""

import json

import numpy as np
from scipy.spatial import transform

from starjax import rcm
from starjax.addons.formats import base
from starjax.addons.formats.base import Column, Source

HZ, STEPS = 30, 90
# Trocars in the frame of the files, which is no task's.
TROCARS = np.array([[0.40, 0.10, 0.30], [0.47, 0.12, 0.31]])
FRAME = transform.Rotation.from_rotvec([0.4, -2.0, 0.7])
_DVRK_TIP = 0.0102  # m, from the yaw axis, where dVRK's frame ends, to the jaws' ends
_HALF_TURN = transform.Rotation.from_euler("z", np.pi)


def shafts(trocar, seed):
    """Poses R, p `[STEPS]` of a shaft through a trocar, and angles of a wrist that moves."""
    times = np.arange(STEPS) / HZ + 5.0 * seed
    offset = np.stack(
        [0.04 * np.sin(1.3 * times), 0.04 * np.cos(0.9 * times), -0.1 + 0.02 * np.sin(0.7 * times)],
        -1,
    )
    R = rcm.rotation_from_axis_roll(offset.astype(np.float32), (0.8 * times).astype(np.float32))
    R = transform.Rotation.from_matrix(np.asarray(R, np.float64))
    angles = np.stack([0.6 * np.sin(0.8 * times), 0.5 * np.cos(1.1 * times)], -1)
    return (FRAME * R).as_matrix(), trocar + FRAME.apply(offset), angles


def arm(seed, wristed, trocar=None):
    """One arm's columns: position, rotation, jaw, joints, of a tip as dVRK's files have it."""
    trocar = TROCARS[seed % 2] if trocar is None else trocar
    R, p, angles = shafts(trocar, seed)
    jaw = 0.5 + 0.5 * np.sin(np.arange(STEPS) / 9.0)
    joints = np.concatenate([np.zeros((STEPS, 4)), angles], -1)
    if wristed:
        pose = rcm.tip_of(rcm.LARGE_NEEDLE_DRIVER, rcm.Pose(R, p), angles)
        R, p = np.asarray(pose.R, np.float64), np.asarray(pose.p, np.float64)
        p = p - _DVRK_TIP * R[..., 2]
        R = R @ _HALF_TURN.as_matrix()
    return p, transform.Rotation.from_matrix(R), jaw[:, None], joints


def tips(trocar, seed, wristed):
    """Tips `[STEPS, 3]` of the jaws' ends."""
    R, p, angles = shafts(trocar, seed)
    if not wristed:
        return p
    return np.asarray(rcm.tip_of(rcm.LARGE_NEEDLE_DRIVER, rcm.Pose(R, p), angles).p)


def _next(x):
    return np.concatenate([x[1:], x[-1:]])


def _pair(numbers):
    return np.concatenate([numbers(seed) for seed in (0, 1)], -1)


def _pose(order):
    """Numbers of an arm's pose and jaw, quaternions in that order."""

    def numbers(seed, wristed):
        p, R, jaw, _ = arm(seed, wristed)
        quaternion = R.as_quat()
        return [p, quaternion if order == "xyzw" else np.roll(quaternion, 1, -1), jaw]

    return numbers


def dvrk(episode, wristed=False):
    def one(i):
        return np.concatenate(_pose("xyzw")(2 * episode + i, wristed), -1)

    state = _pair(one)
    return {
        "observation.state": state,
        "action": _next(state),
        "observation.images.endoscope.left": _images(),
    }


def hamlyn(episode, wristed=False):
    left, right = (np.concatenate(_pose("wxyz")(2 * episode + i, wristed), -1) for i in range(2))
    return {
        "observation.state.left_arm_cartesian": left,
        "observation.state.right_arm_cartesian": right,
        "action.cartesian_absolute": _next(np.concatenate([left, right], -1)),
        "observation.images.color": _images(),
    }


def stanford(episode, wristed=True):
    def one(i):
        p, R, jaw, joints = arm(2 * episode + i, wristed)
        return np.concatenate([joints, jaw, p, R.as_euler("xyz")], -1)

    state = _pair(one)
    poses = np.concatenate([state[:, [6, *range(7, 13)]], state[:, [19, *range(20, 26)]]], -1)
    return {
        "observation.state": state,
        "action": _next(poses),
        "observation.images.camera_left": _images(),
    }


def ucb(episode, wristed=True):
    def joints(i):
        *_, jaw, q = arm(2 * episode + i, wristed)
        return np.concatenate([q, jaw], -1)

    poses = dvrk(episode, wristed)
    return {
        "observation.state": _pair(joints),
        "observation.cartesian_state": poses["observation.state"],
        "action.cartesian_state": poses["action"],
        "observation.images.left": _images(),
    }


def tud(episode, wristed=False):
    p, R, *_ = arm(episode, wristed, TROCARS[0])
    state = np.zeros((STEPS, 35))
    state[:, :3], state[:, 28:31] = p - p[0], p[0]
    state[:, 21:24], state[:, 24:28], state[:, 31:34] = p, R.as_quat(), TROCARS[0]
    steps = np.diff(p, axis=0, append=p[-1:])
    return {
        "observation.state": state,
        "action": np.concatenate([steps, np.zeros((STEPS, 1))], -1),
        "observation.images.laparoscope_left": _images(),
    }


def tud_grasp(episode, wristed=False):
    p, R, *_ = arm(episode, wristed, TROCARS[0])
    state = np.zeros((STEPS, 33))
    state[:, 26:29], state[:, 29:33] = p, R.as_quat()
    is_open = (np.arange(STEPS) % 40 < 20).astype(float)[:, None]
    return {
        "observation.state": state,
        "action": np.concatenate([np.zeros((STEPS, 4)), is_open], -1),
        "observation.images.laparoscope_left": _images(),
    }


def _images():
    shade = np.arange(STEPS, dtype=np.uint8)[:, None, None, None]
    return np.broadcast_to(shade, (STEPS, 12, 16, 3)).copy()


SHAPES = {
    "open-h-dvrk": dvrk,
    "open-h-hamlyn": hamlyn,
    "open-h-stanford": stanford,
    "open-h-ucb": ucb,
    "tud-ur5e": tud,
    "tud-ur5e-grasp": tud_grasp,
}
_NAMES = tuple(
    name
    for i in (1, 2)
    for name in (
        *(f"psm{i}_pose.position.{axis}" for axis in "xyz"),
        *(f"psm{i}_pose.orientation.{axis}" for axis in "xyzw"),
        f"psm{i}_jaw",
    )
)
_SETPOINTS = tuple(name.replace("pose", "sp").replace("jaw", "jaw_sp") for name in _NAMES)
SPLITS = {"train": "0:2", "test": "2:3", "failure": "3:4"}


def source(name, episodes=4, **given):
    """Four episodes as a source; texts as Open-H has them."""
    found = [SHAPES[name](i, **given) for i in range(episodes)]
    found = [
        {k: x if x.dtype == np.uint8 else x.astype(np.float32) for k, x in arrays.items()}
        for arrays in found
    ]
    columns = {k: Column(x.shape[1:], x.dtype.name) for k, x in found[0].items()}
    if name == "open-h-dvrk":
        columns["observation.state"] = Column((16,), "float32", _NAMES)
        columns["action"] = Column((16,), "float32", _SETPOINTS)
    return Source(
        hz=float(HZ),
        lengths=[STEPS] * episodes,
        columns=columns,
        read=lambda i, names: {k: found[i][k] for k in names},
        task="move about",
        robot="dvrk",
        texts=lambda episode: {
            "instruction.text": ["pick up the needle"],
            "observation.meta.tool.psm1": ["Large Needle Driver"],
        },
    )


def write(root, name, **given):
    """Writes it as LeRobot v2.1, with splits and unmapped columns; returns the path."""
    made = source(name, **given)
    base.FORMATS.get("lerobot-v2.1").write(root, made, False)
    path = root / "meta/info.json"
    about = json.loads(path.read_text())
    about["splits"] = SPLITS
    features = about["features"]
    for column in ("observation.state", "action"):
        if names := features.get(column, {}).get("names"):
            features[column]["names"] = [names]  # nested, as peers' converters write them
    features["observation.images.depth"] = {"dtype": "video", "shape": [12, 16, 1], "names": None}
    path.write_text(json.dumps(about))
    return root
