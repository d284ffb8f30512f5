"""States of a dataset's files, compared before a stopped import resumes."""

import hashlib
from pathlib import Path
from typing import NamedTuple

_END = 1 << 20  # bytes of a file's beginning and end, where formats have headers and indices


class FileState(NamedTuple):
    """Bytes of a file, its time of change in ns, and a digest of its ends.

    A copy may keep size and time of another file.
    """

    size: int
    time_ns: int
    digest: str


def of(path: Path) -> dict[str, FileState]:
    """Returns the states of the files of a dataset by name."""
    paths = [path] if path.is_file() else sorted(path.rglob("*"))
    return {x.relative_to(path.parent).as_posix(): _state(x) for x in paths if x.is_file()}


def _state(path: Path) -> FileState:
    about = path.stat()
    with open(path, "rb") as file:
        ends = file.read(_END)
        file.seek(max(about.st_size - _END, 0))
        digest = hashlib.sha256(ends + file.read(_END)).hexdigest()
    return FileState(about.st_size, about.st_mtime_ns, digest)
