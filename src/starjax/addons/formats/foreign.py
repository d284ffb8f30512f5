"""Import of other datasets through a mapping, in two passes over the files.

The first reads numbers only, for anomalies and trocars. The second writes episodes,
with images, as `data.demos` would have.
"""

import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from starjax import rcm
from starjax.addons.formats import mapping as maps
from starjax.addons.formats import motion, selection, stopped, survey
from starjax.addons.formats.base import Source
from starjax.addons.formats.mapping import CameraColumn, Map
from starjax.addons.formats.motion import HZ
from starjax.addons.formats.survey import Kept
from starjax.core import errors
from starjax.data import schema, store
from starjax.runtime import files, xla
from starjax.sim import registries
from starjax.sim.rollouts import episodes
from starjax.sim.task import Task


class Imported(NamedTuple):
    """A finished import.

    Attributes:
      digest: of the dataset.
      episodes: kept. left_out: not kept. frames: of those that are kept.
      p_world_trocar: `[E, A, 3]` m of the kept episodes.
      residual_mm: `[E, A]` root mean square of the shafts' distances from it.
      notes: anomalies, one per line.
      remarks: on columns and images, no anomalies.
      successes: of those that are kept.
    """

    digest: str
    episodes: int
    left_out: int
    frames: int
    p_world_trocar: np.ndarray
    residual_mm: np.ndarray
    notes: list[str]
    remarks: list[str]
    successes: int


def import_mapped(
    source: Source,
    mapping: Map,
    root: Path,
    folder: Path,
    note: Callable[[int], None] = lambda count: None,
) -> Imported:
    """Writes a sealed dataset at `root`; a killed run is resumed.

    Args:
      folder: of the mapping file, where robots' models lie.
      note: called with 1 after every read or written episode.

    Raises:
      errors.UsageError: the mapping does not fit the files or the task, or no episode is left.
      StorageError: `root` cannot be written, or holds another dataset.
    """
    task = registries.tasks.get(mapping.task)
    source, mapping = survey.prepared(source, mapping, folder)
    _fits(mapping, task)
    source = source._replace(notes=[*source.notes, *_squeezed(source, mapping)])
    _require_same_files(root, source)
    found = survey.survey(source, mapping, folder, task, note)
    mapping, hz, kept, notes = found.mapping, found.hz, found.kept, found.notes
    description = _describe(source, mapping, task, kept, found.centres, hz)
    trials = np.zeros(len(found.centres), int)
    present, unread = set(store.keys(root)), set()

    def episodes_to_write() -> Iterator[tuple[str, store.Record, Callable[[], Any]]]:
        for k in kept:
            trial = int(trials[k.trocar])
            trials[k.trocar] += 1
            splits = selection.splits_of(source, k.episode)
            outcome = {
                "trocar": k.trocar,
                **dict(zip(rcm.Trocar._fields, zip(*description["trocars"][k.trocar]))),
                "trial": trial,
                "seed": 0,
                "length": k.length,
                **dict.fromkeys(episodes.FLAGS, False),
                "success": k.success,
                "loose": k.success,
                "stage": 0,
                "labels": dict.fromkeys(task.labels, 0),
                "episode": k.episode,
                **({"splits": splits} if splits else {}),
            }
            key = store.key(k.trocar, trial, 0)
            arrays, reason = {}, ""
            if key in present:
                reason = "" if store.verify(root, key, arrays=False)["files"] else "see above"
            else:
                try:
                    centre = found.centres[k.trocar]
                    arrays = _fields(source, mapping, k, hz, folder, centre, notes)
                except errors.UsageError as error:  # from images, which only this pass reads
                    reason = str(error)
            if reason:
                unread.add(k.episode)
                notes.append(f"episode {k.episode}: {reason}; left out")
                outcome |= {"success": False, "loose": False}
            yield key, outcome, functools.partial(dict, arrays)
        if len(unread) == len(kept):
            raise errors.UsageError("PATH", "demonstrations to keep", notes[-1])
        # After the last episode and before the seal.
        about = {"notes": notes, "residual_mm": np.round(found.residual_mm, 4).tolist()}
        if source.notes:
            about["columns"] = list(source.notes)
        if texts := selection.texts(source, [k.episode for k in kept]):
            about["texts"] = texts
        files.write_json(root / schema.IMPORTED, about)

    frames = sum(k.length for k in kept)
    size = schema.frame_bytes(description["features"]) * frames
    digest = store.write(root, description, episodes_to_write(), size, note)
    count = len(kept) - len(unread)
    left_out = len(source.lengths) - count
    frames = sum(k.length for k in kept if k.episode not in unread)
    return Imported(
        digest=digest,
        episodes=count,
        left_out=left_out,
        frames=frames,
        p_world_trocar=found.p_world_trocar,
        residual_mm=found.residual_mm,
        notes=notes,
        remarks=list(source.notes),
        successes=sum(k.success and k.episode not in unread for k in kept),
    )


def _fits(mapping: Map, task: Task) -> None:
    arms, slots = len(mapping.arms), len(task.slots)
    if arms != slots:
        raise errors.UsageError("--map: arms", f"{slots}, as task {mapping.task} has", arms)
    for name in mapping.cameras:
        errors.choice("--map: cameras", name, task.cameras)
    if not mapping.cameras and not mapping.state:
        raise errors.UsageError("--map", "cameras or a state, to learn from", "neither")


def _require_same_files(root: Path, source: Source) -> None:
    """Records the state of the source's files; a stopped import needs the same ones.

    Raises:
      errors.UsageError: a file changed since the import began.
    """
    path = root / schema.IMPORTED_FILES
    present = {name: list(state) for name, state in source.files().items()}
    if store.keys(root) and path.exists():
        began = files.read_json(path)
        changed = sorted(n for n in {**began, **present} if began.get(n) != present.get(n))
        if changed:
            got = f"{changed[0]}, which changed since, and {len(changed) - 1} more"
            hint = f"remove {root} to begin anew"
            raise errors.UsageError("OUT", "an import of the same files", got, hint)
    elif present:
        files.write_json(path, present)


def _squeezed(source: Source, mapping: Map) -> Iterator[str]:
    """Yields a line for every camera whose images change their ratio of sides."""
    for name, camera in mapping.cameras.items():
        height, width = camera.crop[2:] or source.columns[camera.column].shape[:2]
        if camera.size and height != width:
            yield (
                f"images of camera {name} are squeezed from {height} x {width} to a square: crop "
                "keeps their shape"
            )


def _describe(
    source: Source, mapping: Map, task: Task, kept: list[Kept], centres: np.ndarray, hz: float
) -> dict[str, Any]:
    reference = np.array([slot.p_world_ref for slot in task.slots])
    parameters = rcm.trocar_from_position(centres.astype(np.float32), reference.astype(np.float32))
    shapes = _shapes(source, mapping, len(task.slots), kept[0].episode)
    unknown = [source.robot or "unknown"] * len(task.slots)
    return {
        "schema": store.SCHEMA,
        "per_trocar": int(np.bincount([k.trocar for k in kept]).max()),
        "seed": 0,
        "max_steps": max(k.length for k in kept),
        "keep_failures": True,
        "expert": "imported",
        "scene": {
            "task": mapping.task,
            "arms": unknown,
            "tools": ["unknown"] * len(unknown),
            "cameras": list(mapping.cameras),
        },
        "trocars": np.stack([np.asarray(f, np.float64) for f in parameters], -1).tolist(),
        "p_world_ref": reference.tolist(),
        "roll_zero": [float(slot.roll_zero) for slot in task.slots],
        "control_hz": HZ,
        "task": {
            "fields": [list(field) for field in task.fields],
            "labels": list(task.labels),
            "stages": list(task.stages),
        },
        "features": {
            name: {"shape": list(shape), "dtype": dtype, "what": episodes.what(name)}
            for name, (shape, dtype) in sorted(shapes.items())
        },
        "imported": {"mapping": maps.as_json(mapping), "hz": hz, "task": source.task},
        "versions": xla.versions(),
    }


def _shapes(
    source: Source, mapping: Map, arms: int, episode: int
) -> dict[str, tuple[tuple[int, ...], str]]:
    real = np.dtype(np.float32).str
    shapes: dict[str, tuple[tuple[int, ...], str]] = {
        f"{before}{name}": ((arms, *shape), real)
        for before in ("", "command_")
        for name, shape in (("p", (3,)), ("R", (3, 3)), ("gripper", ()))
    }
    shapes["rcm_error"] = ((arms,), real)
    if maps.has_shaft(mapping):
        shapes |= {"shaft_p": ((arms, 3), real), "shaft_R": ((arms, 3, 3), real)}
    if mapping.state:
        rows = maps.pick(source.read(episode, maps.names(mapping)), mapping.state)
        shapes["state"] = (rows.shape[1:], real)
    for name, camera in mapping.cameras.items():
        shape = source.columns[camera.column].shape
        blank = pictures(np.zeros((1, *shape), np.uint8), camera)
        shapes[f"{episodes.IMAGE}{name}"] = (blank.shape[1:], np.dtype(np.uint8).str)
    return shapes


def _fields(
    source: Source,
    mapping: Map,
    kept: Kept,
    hz: float,
    folder: Path,
    p_world_trocar: np.ndarray,
    notes: list[str],
) -> dict[str, list[np.ndarray]]:
    """Reads the fields of an episode; notes images that stop."""
    columns, poses = motion.of_episode(source, kept.episode, mapping, hz, folder)
    off = np.cross(poses.shaft.p - p_world_trocar, poses.shaft.R[..., 2])
    arrays = {
        "p": poses.pose.p,
        "R": poses.pose.R,
        "gripper": poses.gripper,
        "command_p": poses.command.p,
        "command_R": poses.command.R,
        "command_gripper": poses.command_gripper,
        "rcm_error": np.linalg.norm(off, axis=-1),
    }
    if maps.has_shaft(mapping):
        arrays |= {"shaft_p": poses.shaft.p, "shaft_R": poses.shaft.R}
    if mapping.state:
        arrays["state"] = maps.pick(columns, mapping.state)[poses.nearest - poses.first]
    arrays = {name: array.astype(np.float32) for name, array in arrays.items()}
    cameras = [camera.column for camera in mapping.cameras.values()]
    images = source.read(kept.episode, cameras) if cameras else {}
    for name, camera in mapping.cameras.items():
        shown = images[camera.column][poses.nearest]
        times = np.arange(len(shown)) / HZ
        odd = stopped.images(shown, times, poses.pose.p, name)
        notes += [f"episode {kept.episode}: {line}" for line in odd]
        arrays[f"{episodes.IMAGE}{name}"] = pictures(shown, camera)
    return {name: [arrays[name]] for name in sorted(arrays)}


def pictures(images: np.ndarray, camera: CameraColumn) -> np.ndarray:
    """Crops images `[T, h, w, 3]`, orders them red first, and resizes them."""
    if camera.crop:
        top, left, height, width = camera.crop
        cut = images[:, top : top + height, left : left + width]
        if cut.shape[1:3] != (height, width) or not cut.size:
            got = f"{list(camera.crop)} of {list(images.shape[1:3])}"
            raise errors.UsageError("--map: crop", "a part of the image", got)
        images = cut
    images = images[..., ::-1] if camera.bgr else images
    if camera.size and images.shape[1:3] != (camera.size, camera.size):
        sides = (camera.size, camera.size)
        resized = (Image.fromarray(np.ascontiguousarray(x)).resize(sides) for x in images)
        images = np.stack([np.asarray(image) for image in resized])
    return np.ascontiguousarray(images)
