"""robomimic's HDF5: one file, a group an episode; any HDF5 of such groups is read.

    data            attributes total, env_args
    data/demo_<i>   attribute num_samples; actions [T, n] in [-1, 1], rewards, dones, obs/<name>
    mask/<name>     episodes of a subset

There is no next_obs: it would hold every image twice, and no imitation learner reads it.
"""

import contextlib
import json
import re
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from starjax.addons.formats import base, per_file
from starjax.addons.formats.base import Column, Source
from starjax.sim.rollouts import episodes

if TYPE_CHECKING:  # for annotations alone
    import h5py

SUFFIXES = (".hdf5", ".h5")
_NAMES = {
    "state": "obs/state",
    "action": "actions",
    "trocar": "obs/trocar",
    "environment_state": "obs/environment_state",
    "reward": "rewards",
    "done": "dones",
}
_DEMO = re.compile(r"(?:demo|episode|traj)_?(\d+)")
_MAX_DEPTH = 6  # groups within groups


def named(column: str) -> str:
    """Returns robomimic's name of a starjax column."""
    if column.startswith(episodes.IMAGE):
        return f"obs/{column.removeprefix(episodes.IMAGE)}_image"
    return _NAMES.get(column, column.replace(".", "/", 1))


@contextlib.contextmanager
def _open(path: Path) -> Iterator[Source]:
    with opened(path) as file:
        data: Any = file.get("data", file)
        base.require(isinstance(data, h5py.Group), "a group of episodes", data)
        names = {int(match[1]): name for name in data if (match := _DEMO.fullmatch(name))}
        demos = [data[names[number]] for number in sorted(names)]
        base.require(bool(demos), "groups data/demo_<i>", sorted(data)[:5])
        summaries, faults = per_file.summarise(
            [demo.name for demo in demos], lambda i: episode_length(demos[i])
        )
        lengths = [summaries.get(i, 0) for i in range(len(demos))]
        sound = next(iter(summaries))
        first: dict[str, Any] = datasets(demos[sound])
        ours: Any = file.get(base.OURS)
        columns = {
            name: Column(dataset.shape[1:], dataset.dtype.name, _names(data, name, dataset))
            for name, dataset in first.items()
            if dataset.shape[:1] == (lengths[sound],) and dataset.dtype.kind in "biuf"
        }

        def read(episode: int, names: Collection[str]) -> dict[str, np.ndarray]:
            arrays = {}
            for name in names:
                dataset = demos[episode][name]
                base.require_fits(name, dataset.shape, dataset.dtype)
                arrays[name] = dataset[()]
            return arrays

        origin = None
        if _is_data(ours) and ours.dtype == np.uint8 and ours.ndim == 1:
            base.require_fits(base.OURS, ours.shape, ours.dtype)
            origin = json.loads(bytes(ours[()]))
            base.require(isinstance(origin, dict), f"a map in {base.OURS}", type(origin).__name__)
        about = _attribute(data, "env_args")
        hz = base.origin_hz(origin) or float(_hz(about))
        task, splits = str(about.get("env_name", "")), _splits(file, demos)
        robot = str((about.get("env_kwargs") or {}).get("robot", ""))
        yield Source(hz, lengths, columns, read, origin, task, robot, splits=splits, faults=faults)


def _write(path: Path, source: Source, video: bool) -> None:
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        names = []
        for episode, length in enumerate(source.lengths):
            names.append(f"demo_{episode}")
            demo = data.create_group(names[-1])
            demo.attrs["num_samples"] = length
            for name, array in source.read(episode, source.columns).items():
                if name == "actions":
                    largest = float(np.abs(array).max())
                    base.require(largest <= 1.0, "actions in [-1, 1] (m from the origin)", largest)
                packed: dict[str, Any] = {}
                if source.columns[name].is_image:  # a frame per chunk: they are read in any order
                    packed = {"compression": "gzip", "compression_opts": 1}
                    packed["chunks"] = (1, *array.shape[1:])
                array = array.astype(np.uint8) if array.dtype == bool else array
                demo.create_dataset(name, data=array, **packed)
        data.attrs["names"] = np.bytes_(json.dumps(base.names_of(source)))
        data.attrs["total"] = sum(source.lengths)
        about = {"env_name": source.task, "env_type": 2, "env_kwargs": {"robot": source.robot}}
        data.attrs["env_args"] = np.bytes_(json.dumps(about | {"control_freq": source.hz}))
        for split, part in (source.splits or {"train": range(len(names))}).items():
            some = np.array(names[part.start : part.stop], h5py.string_dtype())
            file.create_dataset(f"mask/{split}", data=some)
        if source.origin:
            # Bytes of a dataset: attributes hold 64 kB, and a damaged string hangs HDF5.
            text = json.dumps(source.origin).encode()
            file.create_dataset(base.OURS, data=np.frombuffer(text, np.uint8))


def _splits(file: "h5py.File", demos: list[Any]) -> dict[str, range]:
    """Returns the masks whose episodes follow one another."""
    numbers = {demo.name.rpartition("/")[2].encode(): i for i, demo in enumerate(demos)}
    masks: Any = file.get("mask", {})
    splits = {}
    for name, mask in masks.items():
        listed = np.ravel(mask[()]).tolist() if _is_data(mask) else []
        rows = [numbers.get(one, -1) for one in listed]
        if rows and rows == [*range(max(rows[0], 0), max(rows[0], 0) + len(rows))]:
            splits[name] = range(rows[0], rows[0] + len(rows))
    return splits


def _recognises(path: Path) -> bool:
    return path.is_file() and path.suffix in SUFFIXES


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Any]:
    """Opens an HDF5 file without links that lead out of it.

    No lock is taken: network file systems may refuse it.
    """
    with h5py.File(path, "r", locking=False) as file:
        _refuse_links(file)
        yield file


def _refuse_links(file: h5py.File) -> None:
    """Refuses files that lead out of themselves, in circles, or many ways to the same place."""
    addresses = set()

    def look(group: "h5py.Group", depth: int) -> None:
        base.require(depth <= _MAX_DEPTH, f"at most {_MAX_DEPTH} groups deep", group.name)
        address = h5py.h5o.get_info(group.id).addr
        # With sixty names a group, six deep, a file of 100 kB has more paths than can be walked.
        base.require(address not in addresses, "one name a group", f"another: {group.name}")
        addresses.add(address)
        for name in group:
            link = group.get(name, getlink=True)
            plain = isinstance(link, h5py.HardLink)
            base.require(plain, "no links", f"{type(link).__name__} {group.name}/{name}")
            child = group[name]
            if isinstance(child, h5py.Group):
                look(child, depth + 1)
            elif isinstance(child, h5py.Dataset):
                outside = child.is_virtual or bool(child.external)
                base.require(not outside, "data inside the file", f"{child.name} elsewhere")

    look(file, 0)


def datasets(group: "h5py.Group") -> dict[str, Any]:
    """Returns the datasets of a group by their paths."""
    found = {}
    group.visititems(lambda name, item: found.update({name: item} if _is_data(item) else {}))
    return found


def _is_data(item: Any) -> bool:
    return isinstance(item, h5py.Dataset) and item.shape is not None


def episode_length(demo: "h5py.Group") -> int:
    """Returns the control steps of an episode: those of its actions, or the most common length."""
    base.require(isinstance(demo, h5py.Group), "a group an episode", f"a dataset {demo.name}")
    name = next((name for name in ("actions", "action") if name in demo), None)
    if name is not None:
        actions = demo[name]
        is_steps = _is_data(actions) and bool(actions.shape)
        base.require(is_steps, "a dataset of control steps", actions.name)
        return int(actions.shape[0])
    counts = [dataset.shape[0] for dataset in datasets(demo).values() if dataset.shape]
    base.require(bool(counts), "datasets of control steps", f"none in {demo.name}")
    return int(max(set(counts), key=counts.count))


def _attribute(data: Any, name: str) -> dict[str, Any]:
    # HDF5 may hang over a damaged string of any length, so only those of a fixed one are read.
    if name not in data.attrs or data.attrs.get_id(name).dtype.kind != "S":
        return {}
    try:
        value = json.loads(data.attrs[name])
    except (KeyError, TypeError, ValueError):
        return {}
    return value if isinstance(value, dict) else {}


def _names(data: "h5py.Group", name: str, dataset: h5py.Dataset) -> tuple[str, ...]:
    return base.names_in(_attribute(data, "names"), name, dataset.shape[1:])


def _hz(about: dict[str, Any]) -> float:
    kwargs = about.get("env_kwargs")
    return about.get("control_freq") or (kwargs or {}).get("control_freq") or 0.0


FORMAT = base.Format("HDF5 of robomimic", named, _recognises, _open, _write)
