"""One recording in every format: a tool through a trocar, its jaws, and the times of both."""

import csv
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import pytest
from scipy.spatial import transform
from strangers import TROCARS, moved

from starjax.addons.formats import base
from starjax.addons.formats.base import Column, Source
from starjax.addons.formats.mapping import ArmColumns, Map

HZ, SECONDS = 30.0, 3.0
ROWS = ("csv", "aloha", "robomimic", "zarr", "lerobot")  # formats of rows
BAGS = ("rosbag",)
EPOCH = 1.7e9  # s, of a bag's start


class Recording(NamedTuple):
    """An episode: columns `[T, ...]` by name, and of bags log times by name."""

    columns: dict[str, np.ndarray]
    logged: dict[str, np.ndarray]


def recording(seed: int = 0, hz: float = HZ, **changed: Any) -> Recording:
    """Returns columns `p`, `q` (xyzw), `jaw`, `time`, `jaw_time`."""
    times = np.arange(int(SECONDS * hz)) / hz
    R, p, _ = moved(times, TROCARS[0], seed)
    columns = {"p": p, "q": transform.Rotation.from_matrix(R).as_quat(), "jaw": np.cos(2.0 * times)}
    return Recording(columns | {"time": times, "jaw_time": times} | changed, {})


def mapping(name: str, **changed: Any) -> Map:
    """Returns the mapping of the columns as a format names them."""
    if name in BAGS:
        p, q, jaw, time = "tip[0:3]", "tip[3:7]", "jaw", "time"
    else:
        p, q = columns(name, "p", 3), columns(name, "q", 4)
        jaw, time = columns(name, "jaw", 1), columns(name, "time", 1)
    arm = ArmColumns(position=p, rotation=q, gripper=jaw)
    listed = (p,) if isinstance(p, str) else p
    made = {"time": time, "state": 4 * listed, "arms": (arm,)} | changed
    return Map(task="peg_transfer", **made)


def columns(name: str, column: str, size: int) -> Any:
    """Returns a column as a mapping names it: CSV has one a number."""
    if name == "csv" and size > 1:
        return tuple(f"{column}_{i}" for i in range(size))
    return column


def write(name: str, path: Path, episodes: list[Recording], hz: float = 0.0) -> Path:
    """Writes the episodes in a format, with a rate where it states one."""
    path.mkdir(parents=True, exist_ok=True)
    writers = {"csv": _csv, "aloha": _aloha, "rosbag": _bag}
    if name in writers:
        for i, episode in enumerate(episodes):
            writers[name](path / f"episode_{i}", episode)
        return path
    first = episodes[0].columns
    described = {n: Column(x.shape[1:], x.dtype.name) for n, x in first.items()}
    lengths = [len(e.columns["p"]) for e in episodes]
    source = Source(
        hz or HZ, lengths, described, lambda i, names: {n: episodes[i].columns[n] for n in names}
    )
    path = path / {"robomimic": "d.hdf5"}.get(name, "d")
    base.FORMATS.get(name).write(path, source, False)
    return path


def _csv(path: Path, episode: Recording) -> None:
    flat = {
        (n if x.ndim == 1 else f"{n}_{i}"): x if x.ndim == 1 else x[:, i]
        for n, x in episode.columns.items()
        for i in range(1 if x.ndim == 1 else x.shape[1])
    }
    with open(path.with_suffix(".csv"), "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerows([flat, *zip(*flat.values())])


def _aloha(path: Path, episode: Recording) -> None:
    with h5py.File(path.with_suffix(".hdf5"), "w") as file:
        for name, array in episode.columns.items():
            file[name] = array


def _bag(path: Path, episode: Recording) -> None:
    """Writes topics tip (stamped poses), jaw (joints with a header), state of columns."""
    shown, logged = episode
    times, jaw_times = shown["time"], shown["jaw_time"]
    pose = np.concatenate([shown["p"], shown["q"]], -1)
    topics = {
        "tip": [(t, logged.get("tip", times)[i], pose[i]) for i, t in enumerate(times)],
        "jaw": [
            (t, logged.get("jaw", jaw_times)[i], {"jaw": shown["jaw"][i]})
            for i, t in enumerate(jaw_times)
        ],
    }
    bag(path, topics)


def bag(path: Path, topics: dict[str, list[tuple[float, float, Any]]], storage: str = "MCAP"):
    """Writes a bag: of each topic rows of stamp, log time in s, and value.

    A value of 7 numbers is a pose, a dict joints by name, a number a Float64 without a header.
    """
    rosbags = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types

    def header(t: float) -> Any:
        sec, part = divmod(EPOCH + t, 1.0)
        stamp = types["builtin_interfaces/msg/Time"](sec=int(sec), nanosec=int(1e9 * part))
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id="base")

    def message(t: float, value: Any) -> tuple[str, Any]:
        if isinstance(value, dict):
            kind, empty = "sensor_msgs/msg/JointState", np.zeros(0)
            position = np.array(list(value.values()), np.float64)
            return kind, types[kind](header(t), list(value), position, empty, empty)
        if np.ndim(value):
            kind = "geometry_msgs/msg/PoseStamped"
            point = types["geometry_msgs/msg/Point"](*map(float, value[:3]))
            turn = types["geometry_msgs/msg/Quaternion"](*map(float, value[3:]))
            return kind, types[kind](header(t), types["geometry_msgs/msg/Pose"](point, turn))
        kind = "std_msgs/msg/Float64"
        return kind, types[kind](data=float(value))

    plugin = getattr(rosbags.StoragePlugin, storage)
    with rosbags.Writer(path, version=9, storage_plugin=plugin) as writer:
        rows, connections = [], {}
        for topic, given in topics.items():
            for stamp, log, value in given:
                rows.append((log, topic, *message(stamp, value)))
        for log, topic, kind, filled in sorted(rows, key=lambda row: row[0]):
            if topic not in connections:
                connections[topic] = writer.add_connection(f"/{topic}", kind, typestore=store)
            data = store.serialize_cdr(filled, kind)
            writer.write(connections[topic], int(1e9 * (EPOCH + log)), data)
