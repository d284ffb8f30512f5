"""Demonstrations on disk: one committed folder per episode, hashed, so damage is noticed.

    <root>/dataset.json            what the dataset is; never changes
    <root>/episodes/<key>/*.npy    one array a field, `[T, ...]`, T the episode's control steps
    <root>/episodes/<key>/episode.json   outcome, and each file's hash
    <root>/SEALED.json             written when complete: every episode's hash, one for all of them

Knows no jax and no robot. An episode appears by one rename, so after a kill each is there or not;
a trial that failed and is not kept has a folder with an episode.json alone.
"""

import concurrent.futures
import hashlib
import json
import re
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from starjax.core import errors, sources
from starjax.runtime import files, xla

SCHEMA = 2
_KEY = re.compile(r"\d{4,}-\d{4,}-\d+")  # what `key` gives

Record = dict[str, Any]  # the content of an episode.json


class DamagedEpisode(ValueError):
    """A file of an episode is missing, cut short or altered; the message names it."""


def key(trocar: int, trial: int, seed: int) -> str:
    """Returns the name of a trial's folder."""
    return f"{trocar:04d}-{trial:04d}-{seed}"


def is_key(name: object) -> bool:
    """Returns True for a name in the form of `key`."""
    return isinstance(name, str) and bool(_KEY.fullmatch(name))


def digest(description: Mapping[str, Any]) -> str:
    """Returns twelve hexadecimal digits of a description, without versions and digests of code."""
    return _hash({k: v for k, v in description.items() if k not in ("versions", "source")})[:12]


def folder(out: Path, description: Mapping[str, Any]) -> Path:
    """Returns the folder of a run's dataset."""
    return out / f"demos-{digest(description)}"


def create(root: Path, description: Mapping[str, Any]) -> None:
    """Starts a dataset, or makes sure that the one at `root` is the one described.

    Raises:
      StorageError: `root` holds another dataset, or an unfinished one of other software versions.
      UsageError: a part's code is another under an equal version.
    """
    description = json.loads(json.dumps(description))
    path = root / "dataset.json"
    try:
        files.read_json(path)
    except (FileNotFoundError, ValueError):  # never written, or damaged
        files.write_json(path, description)
        return
    present = read_description(root)
    names = {**description, **present}
    differing = [k for k in names if description.get(k) != present.get(k)]
    ignored = {"source", "versions"} if is_sealed(root) else {"source"}
    differing = [k for k in differing if k not in ignored]
    if differing:
        name = differing[0]
        incomplete = "an incomplete dataset of other software"
        kind = incomplete if name == "versions" else "another dataset"
        raise files.StorageError(
            f"{root} holds {kind}: its {name} is {present.get(name)}, not "
            f"{description.get(name)}; choose another folder, or remove this one"
        )
    sources.refuse_other_code(path, present, description)


def read_description(root: Path) -> dict[str, Any]:
    """Reads dataset.json.

    Raises:
      ValueError: it is missing, or has another schema.
    """
    path = root / "dataset.json"
    try:
        description = json.loads(path.read_text())
        schema = description["schema"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise errors.UsageError(
            "root", "a folder of demonstrations", f"{path}: {reason}"
        ) from error
    if schema != SCHEMA:
        raise ValueError(f"{path}: expected schema {SCHEMA}, got {schema!r}; collect it again")
    return description


def commit(
    root: Path, key: str, outcome: Record, arrays: Mapping[str, Sequence[np.ndarray]]
) -> Record:
    """Writes one episode; it is on disk, whole, when this returns.

    Args:
      outcome: JSON values, e.g. success, trocar, seed.
      arrays: fields `[T, ...]`, each in parts along its first axis; none for a trial that is not
        kept.
    """
    contents = {f"{name}.npy": files.npy(parts) for name, parts in arrays.items()}
    listed = {
        f"{name}.npy": {
            "shape": [sum(map(len, parts)), *parts[0].shape[1:]],
            "dtype": parts[0].dtype.str,
            **_hashed(contents[f"{name}.npy"]),
        }
        for name, parts in arrays.items()
    }
    record = json.loads(json.dumps({"key": key, **outcome, "files": listed}))
    record["digest"] = _hash(record)
    # Last, so that a folder with an episode.json is whole even where renames are not atomic.
    contents["episode.json"] = [(json.dumps(record, indent=1) + "\n").encode()]
    (root / "episodes").mkdir(parents=True, exist_ok=True)
    files.commit_directory(root / "episodes" / key, root / "staging" / key, contents)
    return record


def verify(root: Path, key: str, arrays: bool = True) -> Record:
    """Reads an episode's record after checking it and, with `arrays`, every byte of its files.

    Raises:
      DamagedEpisode: naming the first file that is not as it was written, or is missing.
      StorageError: a file is there and cannot be read.
    """
    folder = root / "episodes" / key
    path = folder / "episode.json"
    content = _read(path, Path.read_bytes)
    try:
        record = json.loads(content)
        expected = record.pop("digest")
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DamagedEpisode(f"{path}: {_reason(error)}") from error
    if _hash(record) != expected or record["key"] != key:
        raise DamagedEpisode(f"{path}: expected content with hash {expected}, got {_hash(record)}")
    for name, file in record["files"].items() if arrays else ():
        got = _read(folder / name, files.sha256)
        if got != file["sha256"]:
            raise DamagedEpisode(f"{folder / name}: expected sha256 {file['sha256']}, got {got}")
    return {**record, "digest": expected}


def verify_all(
    root: Path, keys: Iterable[str], arrays: bool = True
) -> dict[str, Record | DamagedEpisode]:
    """Verifies many episodes on all cores; damage is returned, not raised."""

    def one(key: str) -> Record | DamagedEpisode:
        try:
            return verify(root, key, arrays)
        except DamagedEpisode as error:
            return error

    keys = list(keys)
    with concurrent.futures.ThreadPoolExecutor(xla.cores()) as pool:
        return dict(zip(keys, pool.map(one, keys), strict=True))


def sealed_records(root: Path, sealed: Mapping[str, Any], arrays: bool = True) -> list[Record]:
    """Verifies the episodes of SEALED.json.

    Raises:
      DamagedEpisode: one is damaged, or is not the sealed one.
    """
    records = []
    for key, record in verify_all(root, sealed["episodes"], arrays).items():
        if isinstance(record, DamagedEpisode):
            raise record
        if record["digest"] != sealed["episodes"][key]:
            path = root / "episodes" / key / "episode.json"
            raise DamagedEpisode(f"{path}: is not the episode that SEALED.json lists")
        records.append(record)
    return records


def keys(root: Path) -> list[str]:
    """Returns the keys of committed episodes, ordered by trocar, trial and seed."""
    folder = root / "episodes"
    # others are not ours: file systems and desktops leave files there, and folders (`@eaDir`)
    return sorted(path.name for path in folder.glob("*/") if is_key(path.name))


def clean(root: Path) -> None:
    """Removes what a killed run was writing."""
    shutil.rmtree(root / "staging", ignore_errors=True)


def remove(root: Path, key: str) -> None:
    """Removes one episode."""
    shutil.rmtree(root / "episodes" / key)


def is_sealed(root: Path) -> bool:
    """Returns True if the dataset is complete."""
    return (root / "SEALED.json").exists()


def seal(root: Path, records: Mapping[str, Record]) -> str:
    """Declares the dataset complete; returns the one hash that names its content."""
    episodes = {key: records[key]["digest"] for key in sorted(records)}
    described = files.sha256(root / "dataset.json")
    sealed = {"schema": SCHEMA, "dataset.json": described, "episodes": episodes}
    files.write_json(root / "SEALED.json", {**sealed, "digest": _hash(sealed)})
    return _hash(sealed)


def read_seal(root: Path) -> dict[str, Any]:
    """Reads SEALED.json, and checks it and dataset.json.

    Raises:
      ValueError: the dataset is not complete, or one of the two files is damaged.
    """
    path = root / "SEALED.json"
    if not path.exists():
        raise ValueError(f"{root}: the demonstrations are not complete; run the collection again")
    try:
        sealed = json.loads(path.read_bytes())
        expected = sealed.pop("digest")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: {_reason(error)}") from error
    if _hash(sealed) != expected:
        raise ValueError(f"{path}: expected content with hash {expected}, got {_hash(sealed)}")
    where = root / "dataset.json"
    got = files.sha256(where) if where.exists() else "no file"
    if got != sealed["dataset.json"]:
        raise ValueError(f"{where}: expected sha256 {sealed['dataset.json']}, got {got}")
    return {**sealed, "digest": expected}


def write(
    root: Path,
    description: Mapping[str, Any],
    episodes: Iterable[tuple[str, Record, Callable[[], Mapping[str, Sequence[np.ndarray]]]]],
    size: int = 0,
    note: Callable[[int], None] = lambda count: None,
) -> str:
    """Writes and seals a dataset; a killed run is resumed. Returns its digest.

    Args:
      episodes: key, outcome and reader of the arrays, see `commit`.
      size: bytes of all arrays, for the check of free space.
      note: called with 1 after every episode.

    Raises:
      StorageError: `root` cannot be written, or holds another dataset.
    """
    with files.lock(root):
        create(root, description)
        clean(root)
        files.require_writable(root, size)
        present, records = set(keys(root)), {}
        for key, outcome, read in episodes:
            # Episodes of a killed run are checked, not written again.
            is_present = key in present
            records[key] = verify(root, key) if is_present else commit(root, key, outcome, read())
            note(1)
        return seal(root, records)


def _hashed(parts: Sequence[bytes | memoryview]) -> dict[str, Any]:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part)
    return {"bytes": sum(map(len, parts)), "sha256": digest.hexdigest()}


def _hash(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def _read(path: Path, read: Callable[[Path], Any]) -> Any:
    """Reads an episode's file with `read`; a disk that fails is no damage to it."""
    try:
        return read(path)
    except FileNotFoundError as error:
        raise DamagedEpisode(f"{path}: {error.strerror}") from error
    except OSError as error:
        raise files.StorageError(f"cannot read {path}: {error.strerror or error}") from error


def _reason(error: Exception) -> str:
    if isinstance(error, OSError):
        return error.strerror or str(error)
    return f"cannot be read ({type(error).__name__}: {error})"
