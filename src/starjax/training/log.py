"""The training log: one JSON object a line, the same bytes after a resume as without one."""

import contextlib
import json
import os
import pathlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from starjax.runtime import files

Follower = Callable[[int, str, Mapping[str, Any]], None]  # (step, kind, values)
_followers: list[Follower] = []


@contextlib.contextmanager
def followed_by(follower: Follower) -> Iterator[None]:
    """Calls `follower` with every line that is added meanwhile."""
    _followers.append(follower)
    try:
        yield
    finally:
        _followers.remove(follower)


def resume(path: str | os.PathLike, step: int) -> None:
    """Drops lines after the step that a run resumes from, and incomplete ones."""
    file = pathlib.Path(path)
    file.parent.mkdir(parents=True, exist_ok=True)
    lines = file.read_bytes().splitlines(keepends=True) if file.exists() else []
    kept = b"".join(line for line in lines if _is_until(line, step))
    files.write_bytes(file, kept)


def append(path: str | os.PathLike, step: int, kind: str, values: Mapping[str, Any]) -> None:
    """Adds a line `{"step", "kind", **values}`; without clock times: equal runs log equally.

    Raises:
      StorageError: it cannot be written.
    """
    line = json.dumps({"step": step, "kind": kind, **values})
    try:
        with open(path, "a") as stream:
            stream.write(line + "\n")
    except OSError as error:
        raise files.StorageError(
            f"cannot write {path}: {error.strerror}; training resumes from its last checkpoint"
        ) from error
    for follower in _followers:
        follower(step, kind, values)


def read(path: str | os.PathLike) -> list[dict[str, Any]]:
    """Returns all lines, oldest first."""
    return [json.loads(line) for line in pathlib.Path(path).read_text().splitlines()]


def _is_until(line: bytes, step: int) -> bool:
    try:
        return line.endswith(b"\n") and json.loads(line)["step"] <= step
    except (ValueError, KeyError, TypeError):
        return False
