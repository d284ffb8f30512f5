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

from starjax.addons.formats import base, peer_columns
from starjax.addons.formats.base import Column, Source
from starjax.core import errors
from starjax.data import redraw, store
from starjax.runtime import files, provenance, user_code
from starjax.sim.rollouts import episodes


def source(
    root: Path,
    form: base.Format,
    image_size: int = 0,
    options: peer_columns.PeerOptions = peer_columns.DEFAULT,
) -> Source:
    """Returns a sealed starjax dataset as the source of an export.

    Args:
      root: folder of the dataset.
      form: format of the export.
      image_size: pixels per side of images that are drawn, for a dataset that recorded none; 0
        leaves them out.
      options: of the columns for other tools.

    Raises:
      ValueError: it is not complete, or damaged.
    """
    description = store.read_description(root)
    sealed = store.read_seal(root)
    records = store.sealed_records(root, sealed)
    numbered = [i for i, record in enumerate(records) if record["files"]]
    # Failures last: a split is a span of episodes.
    ordered = sorted(numbered, key=lambda i: not records[i]["success"])
    kept = [records[i] for i in ordered]
    if not kept:
        raise errors.UsageError("DATASET", "episodes", f"{root}: none was kept")
    fields = {
        name: Column(tuple(feature["shape"]), np.dtype(feature["dtype"]).name)
        for name, feature in description["features"].items()
    }
    named = {name: form.named(peer_columns.name_of(name)) for name in fields}
    scene = description["scene"]

    drawn = _drawn(root, description, kept, form, image_size)
    first = np.cumsum([0, *(record["length"] for record in kept)])

    def read(episode: int, names: Collection[str]) -> dict[str, np.ndarray]:
        arrays = _arrays(root, description, kept[episode])
        by_column = {named[name]: array for name, array in arrays.items()}
        derived = peer_columns.derived(arrays, kept[episode], description, options)
        by_column |= {form.named(name): array for name, array in derived.items()}
        rows = np.arange(first[episode], first[episode + 1])
        by_column |= {name: drawn[name][rows] for name in drawn if name in names}
        return {name: by_column[name] for name in names}

    derived_columns = peer_columns.columns(description, options)
    columns = {form.named(name): column for name, column in derived_columns.items()}
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
            **({"order": ordered} if ordered != numbered else {}),
        },
        splits=peer_columns.splits(kept),
        texts=lambda episode: peer_columns.texts(scene),
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

    assert form.write is not None
    with _staged(out) as staged:
        form.write(staged, dataset._replace(read=read), video)
        if not staged.exists():
            subject = user_code.subject(f"format {form.description}", "write", form.write)
            raise errors.UsageError(subject, f"a file or folder {staged}", "nothing")


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
    ordered = _order(origin)
    count, place = len(ordered), {number: i for i, number in enumerate(ordered)}
    rows = (
        (outcome["key"], outcome, functools.partial(_ours, dataset, origin, place[i]))
        if i in place
        else (outcome["key"], outcome, dict)
        for i, outcome in enumerate(origin["records"])
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


def _arrays(root: Path, about: dict[str, Any], record: store.Record) -> dict[str, np.ndarray]:
    """Reads the fields of an episode."""
    folder = root / "episodes" / record["key"]
    return {name: np.load(folder / f"{name}.npy", allow_pickle=False) for name in about["features"]}


def _order(origin: dict[str, Any]) -> list[int]:
    """Returns the numbers of the records that the files hold, in the order of the files."""
    numbered = [i for i, is_stored in enumerate(origin["stored"]) if is_stored]
    return origin.get("order", numbered)


def _checked(origin: dict[str, Any], dataset: Source) -> dict[str, Any]:
    """Checks that an origin is complete and fits the files; it is untrusted input."""
    try:
        description, records = origin["description"], origin["records"]
        counts = len(records), len(origin["stored"])
        base.require(counts[0] == counts[1], f"{counts[0]} episodes", counts[1])
        ordered, numbered = _order(origin), _order({"stored": origin["stored"]})
        base.require(sorted(ordered) == numbered, "an order of the episodes", ordered)
        lengths = [records[i]["length"] for i in ordered]
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
