"""Reads collected demonstrations: checked, and placed where they fit (device, host, or disk)."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import numpy as np

from starjax import rcm
from starjax.core import errors
from starjax.core.types import Command, Observation, Pose
from starjax.data import redraw, schema, store, windows
from starjax.data.episode_array import EpisodeArray
from starjax.data.placed_images import JoinedImages
from starjax.runtime import files, xla
from starjax.sim.rollouts import episodes
from starjax.sim.state import Env

Residency = Literal["auto", "device", "host", "disk"]

DEVICE_SHARE = 0.5  # part of the device's free memory that demonstrations may take
HOST_SHARE = 0.6  # part of the host's


class Demos(NamedTuple):
    """A dataset, and what it is.

    Attributes:
      dataset: the frames, as `windows.Dataset`.
      digest: hash that names the content on disk.
      residency: `device`, `host` or `disk`.
      bytes: memory they take there (on the disk: what is read from there).
      description: the content of dataset.json.
    """

    dataset: windows.Dataset
    digest: str
    residency: str
    bytes: int
    description: dict[str, Any]


def load(
    root: Path,
    *,
    residency: Residency = "auto",
    verify: bool = True,
    images: bool = True,
    env: Env | None = None,
    sources: bool = False,
    rows: int = 0,
    report: Callable[[str], None] = print,
) -> Demos:
    """Loads the successful episodes of a sealed dataset, after checking every byte of them.

    Args:
      root: folder of the dataset.
      residency: "auto" takes the device if the frames fit there, else the host, else leaves
        images on disk.
      verify: without it only the episodes' records are checked, not their arrays: for a caller
        that has just run `demos.collect`, which checks all.
      images: without them they stay on disk, whatever the residency; `frames` reads them.
      env: `sim.env.Env` that draws the images that were not recorded at its size.
      sources: keep the sources of images, for a training that draws some of them anew.
      rows: room for so many frames on the device; programs are compiled for it.
      report: gets one line with the place and the bytes, before any is allocated.

    Raises:
      DamagedEpisode: names the file that is not as it was written.
      ValueError: no dataset, or not complete.
      UsageError: sources of images of others, or of another scene.
    """
    root = Path(root)
    description = store.read_description(root)
    sealed = store.read_seal(root)
    records = _successful(root, sealed, verify)
    if sources:
        redraw.expect_possible("sources", description)
    is_drawn = images and _is_drawn(description, env)
    found = (
        redraw.sources(root, description, records, env) if env and (sources or is_drawn) else None
    )
    drawn = redraw.images_of(found, records, env) if env and found and is_drawn else {}
    fields = _fields(description, records[0], images and not drawn)
    total = sum(r["files"][file]["bytes"] for r in records for file in fields.values())
    total += sum(math.prod(array.shape) for array in drawn.values())  # uint8: a byte each
    place = place_for(total) if residency == "auto" else residency
    without = "" if images else " without images"
    where = whereabouts(place, bool(drawn))
    report(f"{len(records)} demonstrations, {files.size(total)}{without}: {where}")
    dataset = _dataset(root, description, records, place, fields, drawn, rows)
    if found and sources:
        rows = len(dataset.episode) - len(found.qpos)
        dataset = dataset.replace(
            sources=found._replace(qpos=np.pad(found.qpos, ((0, rows), (0, 0))))
        )
    return Demos(dataset, sealed["digest"], place, total, description)


def verify(root: Path) -> None:
    """Checks every byte of the successful episodes; raises as `load`."""
    _successful(Path(root), store.read_seal(Path(root)), verify=True)


def actors(root: Path) -> np.ndarray:
    """Returns the agents `[F]` uint8 of a dataset's commands in the order of `load`.

    See `episodes.FIELDS`; a dataset without this field has an expert's. Only the episodes' records
    are checked.
    """
    records = _successful(root, store.read_seal(root), verify=False)
    length, start = _spans(records)
    if "actor.npy" not in records[0]["files"]:
        return np.ones(int(length.sum()), np.uint8)
    return EpisodeArray(_paths(root, records, "actor.npy"), start, length).read()


def frames(root: Path, env: Env | None = None) -> "Mapping[str, EpisodeArray | redraw.DrawnImages]":
    """Returns the images of the successful episodes by camera, in the order of `load`.

    They are read or drawn when they are indexed. Only the episodes' records are checked.

    Args:
      root: folder of the dataset.
      env: as for `load`.

    Raises:
      DamagedEpisode, ValueError: as `load`; also without images or an environment to draw them.
    """
    root = Path(root)
    description = store.read_description(root)
    records = _successful(root, store.read_seal(root), verify=False)
    if env and _is_drawn(description, env):
        return redraw.images(root, description, records, env)
    fields = _fields(description, records[0], images=True)
    length, start = _spans(records)
    found = {
        name.removeprefix(episodes.IMAGE): EpisodeArray(_paths(root, records, file), start, length)
        for name, file in fields.items()
        if name.startswith(episodes.IMAGE)
    }
    if not found:
        raise errors.UsageError("root", "demonstrations with images", root)
    return found


_WHERE = {
    "device": "resident on the device",
    "host": "in host memory (they do not fit the device)",
    "disk": "read from disk (they fit neither the device nor host memory)",
}
_DRAWN = "drawn for each batch (they fit neither the device nor host memory)"


def whereabouts(place: str, is_drawn: bool) -> str:
    """Returns a place in words; `is_drawn` says whether images are drawn, not read."""
    return _DRAWN if is_drawn and place == "disk" else _WHERE[place]


# Recorded, but not trained on.
_UNREAD = ("qpos", "rcm_error", "actor", "shaft_p", "shaft_R")


def _successful(root: Path, sealed: dict[str, Any], verify: bool) -> list[store.Record]:
    """Returns the records of successful episodes, once all episodes are verified."""
    records = [r for r in store.sealed_records(root, sealed, verify) if r["success"]]
    if not records:
        raise errors.UsageError("root", "successful demonstrations", f"none in {root}")
    return records


def _fields(description: dict[str, Any], record: store.Record, images: bool) -> dict[str, str]:
    """Returns the fields that training reads, and the file of each."""
    found = {
        name: f"{name}.npy"
        for name in description["features"]
        if name not in _UNREAD and (images or not name.startswith(episodes.IMAGE))
    }
    return {name: file for name, file in found.items() if file in record["files"]}


def _is_drawn(description: dict[str, Any], env: Env | None) -> bool:
    """Returns True if an environment draws the images: they were not recorded at its size."""
    return (
        env is not None
        and not redraw.are_recorded(description, env)
        and redraw.is_possible(description)
    )


def _spans(records: list[store.Record]) -> tuple[np.ndarray, np.ndarray]:
    """Returns each episode's number of frames `[D]` and first frame `[D]`."""
    length = np.array([record["length"] for record in records], np.int32)
    return length, (np.cumsum(length) - length).astype(np.int32)


def _paths(root: Path, records: list[store.Record], file: str) -> list[Path]:
    return [root / "episodes" / record["key"] / file for record in records]


def place_for(total: int) -> Residency:
    """Returns the place of so many bytes: the device if they fit, else the host, else the disk."""
    device = jax.local_devices()[0]
    host = xla.available_bytes()
    stats = device.memory_stats() or {}
    free = stats.get("bytes_limit", 2 * host) - stats.get("bytes_in_use", 0)
    if device.platform == "cpu":  # jax copies them within the same memory, for each device
        free = HOST_SHARE * host / jax.local_device_count()  # each virtual device has a copy
    # EpisodeArray pass through host memory on their way to the device.
    if total <= DEVICE_SHARE * free and total <= HOST_SHARE * host:
        return "device"
    return "host" if total <= HOST_SHARE * host else "disk"


def _dataset(
    root: Path,
    description: dict[str, Any],
    records: list[store.Record],
    place: str,
    files_of: dict[str, str],
    drawn: Mapping[str, redraw.DrawnImages],
    rows: int,
) -> windows.Dataset:
    length, start = _spans(records)
    count = int(length.sum())
    rows = max(windows.padded_count(count), rows) if place == "device" else count
    episode = np.repeat(np.arange(len(records), dtype=np.int32), length)  # frame -> demonstration
    fields, images = {}, {}
    for name, file in files_of.items():
        # Only images are large; everything else is read in any case.
        joined = EpisodeArray(_paths(root, records, file), start, length)
        if name.startswith(episodes.IMAGE):
            camera = name.removeprefix(episodes.IMAGE)
            images[camera] = joined if place == "disk" else joined.read(rows)
        else:
            fields[name] = joined.read(rows)
    for camera, array in drawn.items():
        images[camera] = JoinedImages([array]).at(place, rows)
    told = rcm.trocar_frame(
        schema.trocars_of(records),
        np.array(description["p_world_ref"], np.float32),
        np.array(description["roll_zero"], np.float32),
    )
    dataset = windows.Dataset(
        observation=Observation(
            pose=Pose(fields["R"], fields["p"]),
            gripper=fields["gripper"],
            images=images or None,
            state=fields.get("state"),
            endoscope=_endoscope(fields),
            wrist=fields.get("wrist"),
        ),
        command=Command(
            pose=Pose(fields["command_R"], fields["command_p"]),
            gripper=fields["command_gripper"],
            wrist=fields.get("command_wrist"),
        ),
        trocar=jax.tree.map(np.asarray, told),
        episode=np.pad(episode, (0, rows - count)),
        start=start,
        length=length,
    )
    return jax.device_put(dataset) if place == "device" else dataset


def _endoscope(fields: dict[str, Any]) -> Pose | None:
    known = [fields[name] for name in episodes.ENDOSCOPE if name in fields]
    return Pose(*known) if known else None
