"""ROS bags of CRTK topics, a bag per episode: rosbag2 (MCAP or SQLite) and ROS 1, by rosbags.

A column per topic, without the leading slash:

    geometry_msgs Pose, PoseStamped, Transform, TransformStamped   x y z qx qy qz qw
    sensor_msgs JointState                                         positions, by their names
    geometry_msgs Wrench, WrenchStamped                            forces N, torques N m
    sensor_msgs CompressedImage, Image (rgb8, bgr8)                [h, w, 3]
    std_msgs Float64, Float32, Bool, Int32                         the number

They are joined as `timing` says. `time` is in s from the first step.
"""

import contextlib
import functools
import tempfile
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from starjax.addons.formats import base, per_file, ros_messages, timing
from starjax.addons.formats.base import Column, Source, StepTimes
from starjax.core import extras

if TYPE_CHECKING:  # for annotations alone
    from rosbags.highlevel import AnyReader

_SUFFIXES = (".mcap", ".db3", ".bag")
_META = "metadata.yaml"  # for a folder that is a rosbag2
_TIME = "time"
_OF_URIS = "#?%"  # characters that rosbags leaves in the URI of an SQLite file
_KEPT = 4  # episodes whose times are kept


@contextlib.contextmanager
def _open(path: Path) -> Iterator[Source]:
    extras.require("rosbag", "ros")
    bags = _bags(path)
    base.require(bool(bags), "bags", f"none in {path}")
    counts, faults = per_file.summarise([bag.name for bag in bags], lambda i: _counts(bags[i]))
    columns, notes = _columns(bags[next(iter(counts))])
    yield _joined(bags, counts, faults, columns, notes, [_clock(columns, counts), *columns])


def _joined(
    bags: Sequence[Path],
    counts: dict[int, dict[str, int]],
    faults: dict[int, str],
    columns: dict[str, Column],
    notes: Sequence[str],
    names: Sequence[str],
) -> Source:
    """Returns the source of streams joined at the messages of the first of `names`."""
    streams = list(dict.fromkeys(name for name in names if name != _TIME))
    clock = streams[0]

    @functools.lru_cache(_KEPT)
    def join(episode: int) -> tuple[StepTimes, dict[str, np.ndarray]]:
        with _reader(bags[episode]) as reader:
            present = [name for name in streams if counts[episode].get(name)]
            return timing.join({name: _stream(reader, name) for name in present}, clock)

    def read(episode: int, names: Collection[str]) -> dict[str, np.ndarray]:
        clocked, rows = join(episode)
        arrays = {}
        with _reader(bags[episode]) as reader:
            for name in names:
                if name == _TIME:
                    arrays[name] = clocked.times - clocked.times[0]
                else:
                    base.require(name in rows, f"messages of {name}", "none")
                    values = _values(reader, name, columns[name])
                    arrays[name] = values[np.maximum(rows[name], 0)]
        return arrays

    absent = {
        i: f"{bags[i].name}: no messages of {clock}" for i in counts if not counts[i].get(clock)
    }
    return Source(
        hz=0.0,
        lengths=[counts[i].get(clock, 0) if i in counts else 0 for i in range(len(bags))],
        columns=columns,
        read=read,
        notes=notes,
        faults=faults | absent,
        timing=lambda episode: join(episode)[0],
        by=lambda names: _joined(bags, counts, faults, columns, notes, names),
    )


def _bags(path: Path) -> list[Path]:
    if path.is_file() or (path / _META).is_file():
        return [path]
    bags = [file for suffix in _SUFFIXES for file in per_file.listed(path, f"*{suffix}")]
    return bags or [meta.parent for meta in per_file.listed(path, f"*/{_META}")]


@contextlib.contextmanager
def _reader(path: Path) -> Iterator[Any]:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    with contextlib.ExitStack() as stack:
        paths = [path]
        databases = [path] if path.suffix == ".db3" else per_file.listed(path, "*.db3")
        if any(set(_OF_URIS) & set(str(database.absolute())) for database in databases):
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            paths = [folder / f"{i}.db3" for i in range(len(databases))]
            for link, database in zip(paths, databases):
                link.symlink_to(database.absolute())
        # Bags of older releases lack the definitions of their messages.
        store = get_typestore(Stores.LATEST)
        yield stack.enter_context(AnyReader(paths, default_typestore=store))


def _counts(path: Path) -> dict[str, int]:
    """Returns the number of messages of each topic."""
    counts: dict[str, int] = {}
    with _reader(path) as reader:
        for connection in reader.connections:
            name = _name(connection.topic)
            counts[name] = counts.get(name, 0) + connection.msgcount
    return counts


def _columns(path: Path) -> tuple[dict[str, Column], list[str]]:
    """Returns the columns of a bag, and notes on topics that are not read."""
    columns, notes = {_TIME: Column((), "float64")}, []
    with _reader(path) as reader:
        for connection in sorted(reader.connections, key=lambda c: c.topic):
            name = _name(connection.topic)
            if connection.msgtype not in ros_messages.READERS:
                notes.append(f"{name}: {connection.msgtype} is not read; omitted")
                continue
            first = next(reader.messages([connection]), None)
            if first is None:
                notes.append(f"{name}: no messages; omitted")
                continue
            message = reader.deserialize(first[2], connection.msgtype)
            names = ros_messages.names(message)
            value = ros_messages.value(message, names)
            columns[name] = Column(value.shape, value.dtype.name, names)
    return columns, notes


def _clock(columns: dict[str, Column], counts: dict[int, dict[str, int]]) -> str:
    """Returns the stream of the steps of a bag without a mapping: the fastest of the poses."""
    first = next(iter(counts.values()))
    names = [name for name in columns if name != _TIME]
    base.require(bool(names), "topics with messages", "none")
    poses = [name for name in names if columns[name].names[3:] == ("qx", "qy", "qz", "qw")]
    return max(poses or names, key=lambda name: first.get(name, 0))


def _messages(reader: "AnyReader", name: str) -> Iterator[tuple[Any, int]]:
    """Yields the messages of a topic, with the ns of their recording."""
    connections = [c for c in reader.connections if _name(c.topic) == name]
    base.require(bool(connections), f"a topic {name}", "none")
    for connection, logged, raw in reader.messages(connections):
        yield reader.deserialize(raw, connection.msgtype), logged


def _stream(reader: "AnyReader", name: str) -> timing.Stream:
    times = [
        (ros_messages.seconds(m, logged), 1e-9 * logged) for m, logged in _messages(reader, name)
    ]
    base.require(bool(times), f"messages of {name}", "none")
    return timing.Stream(*np.array(times).T)


def _values(reader: "AnyReader", name: str, column: Column) -> np.ndarray:
    """Returns values `[N, ...]` of a topic in the order of the log."""
    count = sum(c.msgcount for c in reader.connections if _name(c.topic) == name)
    base.require_fits(name, (count, *column.shape), column.dtype)
    values = [ros_messages.value(message, column.names) for message, _ in _messages(reader, name)]
    base.require(len({value.shape for value in values}) == 1, f"{name} of one size", "several")
    return np.stack(values)


def _name(topic: str) -> str:
    return topic.lstrip("/")


def _recognises(path: Path) -> bool:
    if path.is_dir():
        return (path / _META).is_file() or bool(_bags(path))
    return path.suffix in _SUFFIXES


_ABOUT = "ROS bags of CRTK topics, a bag per episode"
FORMAT = base.Format(_ABOUT, per_file.same_name, _recognises, _open)
