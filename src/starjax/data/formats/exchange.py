"""Export of starjax datasets to other formats, and restoring them byte by byte.

An export has the columns that its peers expect (state, action, trocar, images) and every field of
ours as it is, under `starjax.<field>`. Images are there once.
"""

import contextlib
import functools
import json
import shutil
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import transform

from starjax import errors, rcm
from starjax.data import redraw, schema, store
from starjax.data.formats import base
from starjax.data.formats.base import Column, Source
from starjax.rollouts import episodes
from starjax.runtime import files, provenance

_AXES = ("x", "y", "z", "qx", "qy", "qz", "qw", "gripper")


def source(root: Path, form: base.Format, image_size: int = 0) -> Source:
    """Returns a sealed starjax dataset as the source of an export.

    Args:
      root: folder of the dataset.
      form: format of the export.
      image_size: pixels per side of images that are drawn, for a dataset that recorded none; 0
        leaves them out.

    Raises:
      ValueError: it is not complete, or damaged.
    """
    description = store.read_description(root)
    sealed = store.read_seal(root)
    records = store.sealed_records(root, sealed)
    kept = [record for record in records if record["files"]]
    if not kept:
        raise errors.UsageError("DATASET", "episodes", f"{root}: none was kept")
    fields = {
        name: Column(tuple(feature["shape"]), np.dtype(feature["dtype"]).name)
        for name, feature in description["features"].items()
    }
    named = {name: form.named(_column(name)) for name in fields}
    scene = description["scene"]

    drawn = _drawn(root, description, kept, form, image_size)
    first = np.cumsum([0, *(record["length"] for record in kept)])

    def read(episode: int, names: Collection[str]) -> dict[str, np.ndarray]:
        arrays = _arrays(root, description, kept[episode])
        by_column = {named[name]: array for name, array in arrays.items()}
        derived = _derived(arrays, kept[episode], description)
        by_column |= {form.named(name): array for name, array in derived.items()}
        rows = np.arange(first[episode], first[episode + 1])
        by_column |= {name: drawn[name][rows] for name in drawn if name in names}
        return {name: by_column[name] for name in names}

    columns = {form.named(name): column for name, column in _extra(description).items()}
    columns |= {named[name]: column for name, column in fields.items()}
    columns |= {name: Column(images.shape[1:], "uint8") for name, images in drawn.items()}
    return Source(
        hz=description["control_hz"],
        lengths=[record["length"] for record in kept],
        columns=columns,
        read=read,
        origin={
            "schema": 1,
            **provenance.code()._asdict(),
            "description": description,
            "records": [_outcome(record) for record in records],
            "stored": [bool(record["files"]) for record in records],
            "columns": named,
            "digest": sealed["digest"],
        },
        task=scene["task"].replace("_", " "),
        robot="_".join(scene["arms"]),
    )


def _drawn(
    root: Path,
    description: dict[str, Any],
    records: list[store.Record],
    form: base.Format,
    size: int,
) -> dict[str, redraw.DrawnImages]:
    """Returns images by column, none if they were recorded or cannot be drawn."""
    is_recorded = any(name.startswith(episodes.IMAGE) for name in description["features"])
    if not size or is_recorded or not redraw.is_possible(description):
        return {}
    env = redraw.scene_env(description, size)
    drawn = redraw.images(root, description, records, env)
    return {form.named(f"{episodes.IMAGE}{camera}"): array for camera, array in drawn.items()}


def export(
    dataset: Source,
    out: Path,
    form: base.Format,
    video: bool = True,
    note: Callable[[int], None] = lambda count: None,
) -> None:
    """Writes a source in a format; `out` appears once complete.

    Args:
      note: called with 1 after every written episode.
    """

    def read(episode: int, names: Collection[str]) -> dict[str, np.ndarray]:
        note(1)
        return dataset.read(episode, names)

    with _staged(out) as staged:
        form.write(staged, dataset._replace(read=read), video)


def restore_export(
    dataset: Source, root: Path, note: Callable[[int], None] = lambda count: None
) -> dict[str, Any]:
    """Writes an export of ours, which has an origin, as the dataset that it was.

    Args:
      note: called with 1 after every episode.

    Returns:
      {"digest", "episodes", "same"}: `same` is whether every byte is as it was.

    Raises:
      errors.UsageError: the origin does not describe a dataset.
    """
    assert dataset.origin is not None
    origin = _checked(dataset.origin, dataset)
    count = sum(map(bool, origin["stored"]))
    stored = iter(range(count))
    rows = (
        (outcome["key"], outcome, functools.partial(_ours, dataset, origin, next(stored)))
        if is_stored
        else (outcome["key"], outcome, dict)
        for outcome, is_stored in zip(origin["records"], origin["stored"], strict=True)
    )
    digest = store.write(root, origin["description"], rows, note=note)
    return {"digest": digest, "episodes": count, "same": digest == origin["digest"]}


@contextlib.contextmanager
def _staged(out: Path) -> Iterator[Path]:
    """Yields a path to write; it becomes `out` at once."""
    staged = out.with_name(f".{out.name}.tmp")
    out.parent.mkdir(parents=True, exist_ok=True)
    _remove(staged)
    try:
        yield staged
        staged.rename(out)
    except BaseException:
        _remove(staged)
        raise
    files.sync_directory(out.parent)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _outcome(record: store.Record) -> dict[str, Any]:
    """Returns a record without the entries that `store.commit` adds."""
    return {name: value for name, value in record.items() if name not in ("files", "digest")}


def _column(field: str) -> str:
    return field if field.startswith(episodes.IMAGE) else f"{base.OURS}.{field}"


def _arrays(root: Path, about: dict[str, Any], record: store.Record) -> dict[str, np.ndarray]:
    """Reads the fields of an episode."""
    folder = root / "episodes" / record["key"]
    return {name: np.load(folder / f"{name}.npy", allow_pickle=False) for name in about["features"]}


def _extra(description: dict[str, Any]) -> dict[str, Column]:
    """Returns the columns that other tools expect, derived from starjax's fields."""
    arms = len(description["p_world_ref"])
    names = [f"arm{i}_{axis}" if arms > 1 else axis for i in range(arms) for axis in _AXES]
    places = [
        name.replace("gripper", "") for name in names if name[-1] in "xyz" and "q" not in name
    ]
    columns = {
        "state": Column((8 * arms,), "float32", tuple(names)),
        "action": Column((8 * arms,), "float32", tuple(names)),
        "trocar": Column((3 * arms,), "float32", tuple(places)),
        "reward": Column((), "float32"),
        "done": Column((), "bool"),
    }
    if "state" in description["features"]:
        count = description["features"]["state"]["shape"]
        fields = description.get("task", {}).get("fields", [])
        labels = tuple(f"{name}.{i}" for name, size, *_ in fields for i in range(size))
        columns["environment_state"] = Column(tuple(count), "float32", labels)
    return columns


def _derived(
    arrays: dict[str, np.ndarray], record: store.Record, description: dict[str, Any]
) -> dict[str, np.ndarray]:
    length, places = record["length"], schema.trocars_of([record])
    reference = np.asarray(description["p_world_ref"], np.float32)
    trocar = np.asarray(rcm.trocar_position(places, reference)).reshape(1, -1)
    last = np.arange(length) == length - 1
    derived = {
        "state": _poses(arrays["p"], arrays["R"], arrays["gripper"]),
        "action": _poses(arrays["command_p"], arrays["command_R"], arrays["command_gripper"]),
        "trocar": np.repeat(trocar, length, axis=0).astype(np.float32),
        "reward": (last & record["success"]).astype(np.float32),
        "done": last,
    }
    return derived | ({"environment_state": arrays["state"]} if "state" in arrays else {})


def _poses(p: np.ndarray, R: np.ndarray, gripper: np.ndarray) -> np.ndarray:
    """Packs positions, continuous quaternions xyzw and grippers to `[T, 8 A]`."""
    turned = transform.Rotation.from_matrix(R.reshape(-1, 3, 3)).as_quat()
    turned = turned.reshape(*R.shape[:2], 4)
    # q and -q are one rotation: keep the one nearer to the previous step.
    ahead = np.where(np.sum(turned[1:] * turned[:-1], -1, keepdims=True) < 0, -1.0, 1.0)
    turned[1:] *= np.cumprod(ahead, axis=0)
    rows = np.concatenate([p, turned, gripper[..., None]], -1)
    return rows.reshape(len(p), -1).astype(np.float32)


def _checked(origin: dict[str, Any], dataset: Source) -> dict[str, Any]:
    """Checks that an origin is complete and fits the files; it is untrusted input."""
    try:
        description, records = origin["description"], origin["records"]
        counts = len(records), len(origin["stored"])
        base.require(counts[0] == counts[1], f"{counts[0]} episodes", counts[1])
        stored = [r for r, kept in zip(records, origin["stored"]) if kept]
        lengths = [record["length"] for record in stored]
        base.require(lengths == list(dataset.lengths), f"lengths {lengths}", list(dataset.lengths))
        for record in records:
            base.require(store.is_key(record["key"]), "an episode's key", record["key"])
        for field, feature in description["features"].items():
            base.require(field.replace("_", "").isalnum(), "a field's name", field)
            column = dataset.columns[origin["columns"][field]]
            same = np.prod(column.shape) == np.prod(feature["shape"])
            base.require(bool(same), f"{field} of shape {feature['shape']}", column.shape)
        json.dumps(description)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        text = f"{type(error).__name__}: {error}"
        raise errors.UsageError(
            "PATH", "what an export of starjax says of itself", text, "a --map reads it as others'"
        ) from error
    return origin


def _ours(dataset: Source, origin: dict[str, Any], episode: int) -> dict[str, list[np.ndarray]]:
    """Reads the fields of an episode in the order of `rollouts.episodes.assemble`."""
    names, features = origin["columns"], origin["description"]["features"]
    arrays = dataset.read(episode, [names[field] for field in features])
    return {
        field: [
            arrays[names[field]]
            .reshape(dataset.lengths[episode], *features[field]["shape"])
            .astype(np.dtype(features[field]["dtype"]), copy=False)
        ]
        for field in sorted(features)
    }
