"""Files that survive a kill: atomic writes, committed folders, hashes, free space, a folder's lock.

A reader sees a file or folder whole or not at all. Temporary names are fixed, one a target, so the
next run writes over the remains of a killed one; the lock makes sure that only one runs.
"""

import contextlib
import hashlib
import io
import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from starjax.runtime import locks

_BLOCK = 1 << 22


class StorageError(OSError):
    """A file or folder that cannot be used; the message is one line, meant for the user."""


def write_bytes(path: Path, data: bytes) -> None:
    """Writes `path` atomically: after a crash it holds all of the old content or all of `data`."""
    staged = path.with_name(f".{path.name}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _write_synced(staged, [data])
        os.replace(staged, path)
        sync_directory(path.parent)
    except OSError as error:
        with contextlib.suppress(OSError):
            staged.unlink()
        raise _explained(error, path, len(data)) from error


def write_json(path: Path, value: Any) -> None:
    """Writes `value` as indented JSON, atomically. NaN and infinities are refused: not JSON."""
    write_bytes(path, (json.dumps(value, indent=1, allow_nan=False) + "\n").encode())


def read_json(path: Path) -> dict[str, Any]:
    """Returns the object in a JSON file.

    Raises:
      ValueError: the file is damaged; the message names it.
    """
    try:
        content = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:  # the latter for too deep a nesting
        raise ValueError(f"{path} is damaged: {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path} is damaged: expected an object, got {type(content).__name__}")
    return content


def write_npz(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes a compressed .npz atomically; the same arrays always give the same bytes."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    write_bytes(path, buffer.getvalue())


def read_npz(path: Path, names: Sequence[str] = ()) -> dict[str, np.ndarray]:
    """Returns all arrays of an .npz, whose checksums are checked.

    Raises:
      ValueError: the file is damaged, or one of `names` is not in it; the message names it.
    """
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            arrays = dict(archive)
    except FileNotFoundError:
        raise
    except Exception as error:  # a damaged archive fails in a dozen ways
        raise ValueError(f"{path} is damaged: {error}") from error
    if missing := [name for name in names if name not in arrays]:
        raise ValueError(f"{path} is damaged: no {missing[0]} in it")
    return arrays


def npy(parts: Sequence[np.ndarray]) -> list[bytes | memoryview]:
    """Joins arrays along their first axis in numpy's .npy format, without copying them."""
    first = parts[0]
    if first.dtype.hasobject:
        raise ValueError("parts: expected numbers, got Python objects")
    kinds = {f"{part.dtype}{list(part.shape[1:])}" for part in parts}
    if len(kinds) > 1:
        raise ValueError(f"parts: expected one type and shape, got {', '.join(sorted(kinds))}")
    header = io.BytesIO()
    described = {
        "descr": np.lib.format.dtype_to_descr(first.dtype),
        "fortran_order": False,
        "shape": (sum(map(len, parts)), *first.shape[1:]),
    }
    np.lib.format.write_array_header_1_0(header, described)
    flat = (np.ascontiguousarray(part).reshape(-1).view(np.uint8) for part in parts)
    return [header.getvalue(), *(part.data for part in flat)]


def commit_directory(
    final: Path, staged: Path, contents: Mapping[str, Sequence[bytes | memoryview]]
) -> None:
    """Makes folder `final` appear at once with all its files, in the given order.

    Args:
      final: must not exist.
      staged: temporary name on the same file system; an existing one is removed.
      contents: bytes of each file by name, in parts.
    """
    try:
        shutil.rmtree(staged, ignore_errors=True)
        staged.mkdir(parents=True)
        for name, parts in contents.items():
            _write_synced(staged / name, parts)
        sync_directory(staged)
        os.rename(staged, final)
        sync_directory(final.parent)
    except OSError as error:
        shutil.rmtree(staged, ignore_errors=True)
        count = sum(len(part) for parts in contents.values() for part in parts)
        raise _explained(error, final, count) from error


def sha256(path: Path) -> str:
    """Returns the SHA-256 of a file's content, in hexadecimal."""
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while block := file.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def require_writable(directory: Path, free_bytes: int = 0) -> None:
    """Creates `directory` and makes sure that files can be written there and will fit.

    Raises:
      StorageError: it cannot be created or written, or the disk has less than `free_bytes` free.
    """
    probe = directory / ".writable"
    try:
        directory.mkdir(parents=True, exist_ok=True)
        probe.write_bytes(b"x")
        probe.unlink(missing_ok=True)  # another process that starts here may have been quicker
    except FileExistsError as error:
        raise StorageError(f"{directory}: expected a folder, got a file") from error
    except OSError as error:
        with contextlib.suppress(OSError):  # a full disk leaves an empty one
            probe.unlink()
        raise _explained(error, directory) from error
    free = shutil.disk_usage(directory).free
    if free < free_bytes:
        raise StorageError(
            f"{directory}: about {size(free_bytes)} will be written, the disk has {size(free)} free"
        )


@contextlib.contextmanager
def lock(directory: Path, waits: bool = False) -> Iterator[None]:
    """Holds `directory` for this process, however that ends (see `locks.hold`).

    Raises:
      StorageError: another process holds it, unless this one `waits`; or the folder cannot be
        written or locked.
    """
    require_writable(directory)
    with contextlib.ExitStack() as held:
        try:
            held.enter_context(locks.hold(directory / ".lock", waits))
        except locks.Held as holder:
            raise StorageError(
                f"{directory} is in use by {holder}: wait for it, or choose another folder"
            ) from holder
        except OSError as error:
            raise StorageError(
                f"{directory} cannot be locked ({error.strerror or error}): choose a folder on "
                "another disk"
            ) from error
        yield


def sync_directory(path: Path) -> None:
    """Makes creations, renames and removals in a folder survive a crash."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def size(count: float) -> str:
    """Returns a number of bytes for people, e.g. `14.2 GB`."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.1f} GB"


def _write_synced(path: Path, parts: Sequence[bytes | memoryview]) -> None:
    with open(path, "wb") as file:
        file.writelines(parts)
        file.flush()
        os.fsync(file.fileno())


def _explained(error: OSError, path: Path, count: int = 0) -> StorageError:
    much = f" ({size(count)})" if count else ""
    return StorageError(f"cannot write {path}{much}: {error.strerror or error}")
