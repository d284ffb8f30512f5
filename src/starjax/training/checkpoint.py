"""Checkpoints that notice their own damage. The only importer of orbax.

orbax writes the arrays; it restores most flipped bits silently, so every step also carries a
manifest of sha256 hashes. A step is written to a temporary directory and becomes visible by one
rename, with its manifest inside: there are no half steps.
"""

import errno
import hashlib
import json
import os
import pathlib
import shutil
import warnings
from typing import Any

import jax
from orbax.checkpoint import v1 as ocp

from starjax.core.types import ArrayTree
from starjax.runtime import files, processes

_MANIFEST = "manifest.json"
_STATE = "state"
_PREFIX = "step_"
_TEMPORARY = ".writing-"


class DamagedCheckpoint(Exception):
    """A file of a checkpoint is missing, cut short or altered; the message names it."""


def steps(directory: str | os.PathLike) -> list[int]:
    """Returns steps with a committed checkpoint, oldest first."""
    root = pathlib.Path(directory)
    if not root.is_dir():
        return []
    names = [path.name.removeprefix(_PREFIX) for path in root.glob(f"{_PREFIX}*")]
    return sorted(int(name) for name in names if name.isdigit())


def save(directory: str | os.PathLike, step: int, state: Any, *, keep: int) -> pathlib.Path:
    """Writes a step, and afterwards removes all but the newest `keep`.

    Steps from this one on are removed first: `restore` found them damaged, and the training went
    back before them.

    All processes of a run call it together: each writes its part of the arrays, the first the rest.

    Raises:
      files.StorageError: the disk is full, in one plain sentence.
    """
    if keep < 1:
        raise ValueError(f"keep: expected at least 1 checkpoint, got {keep}")
    root = pathlib.Path(directory).absolute()
    writing, final = root / f"{_TEMPORARY}{step}", path_of(root, step)
    if not processes.is_first():
        processes.agree(step)
        ocp.save(str(writing / _STATE), state)
        return final
    root.mkdir(parents=True, exist_ok=True)
    _remove_leftovers(root)
    try:
        _require_space(root, _bytes(state))
        processes.agree(step)
        ocp.save(str(writing / _STATE), state)
        _write_manifest(writing, step, state)
    except Exception as error:
        shutil.rmtree(writing, ignore_errors=True)
        if _is_disk_full(error):
            left = max((s for s in steps(root) if s < step), default=0)
            raise files.StorageError(
                f"no space left in {root} for the checkpoint of step {step} "
                f"({files.size(_bytes(state))}); free some and run the same command again, it "
                f"continues from step {left}"
            ) from error
        raise
    for refused in steps(root):
        if refused >= step:
            _remove(path_of(root, refused))
    writing.rename(final)
    files.sync_directory(root)
    for old in steps(root)[:-keep]:
        _remove(path_of(root, old))
    return final


def restore(directory: str | os.PathLike, like: Any) -> tuple[int, Any] | None:
    """Returns the newest undamaged step, or None without one.

    Args:
      directory: the argument of `save`.
      like: a state of the same structure, of arrays or `jax.ShapeDtypeStruct` with shardings.

    Returns:
      the step and the state, placed like `like`.

    Raises:
      ValueError: the checkpoint is sound but holds another structure, shape or type: it was made
        with other settings.
    """
    for step in reversed(steps(directory)):
        path = path_of(directory, step)
        try:
            manifest = verify(path)
        except DamagedCheckpoint as damage:
            warnings.warn(
                f"checkpoint of step {step} is damaged: {damage}; an earlier one is used",
                stacklevel=2,
            )
            continue
        _check_leaves(path, manifest["leaves"], _leaves(like))
        return step, ocp.load(str(path / _STATE), jax.tree.map(_abstract, like))
    return None


def verify(path: str | os.PathLike) -> dict[str, Any]:
    """Returns a step's manifest after comparing every file; raises DamagedCheckpoint."""
    root = pathlib.Path(path)
    try:
        envelope = json.loads((root / _MANIFEST).read_text())
        manifest = envelope["manifest"]
        sound = envelope["sha256"] == _hash_of_manifest(manifest)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DamagedCheckpoint(f"{root / _MANIFEST} cannot be read ({error})") from error
    if not sound:
        raise DamagedCheckpoint(f"{root / _MANIFEST} does not match its own hash")
    for name, expected in manifest["files"].items():
        file = root / name
        if not file.is_file():
            raise DamagedCheckpoint(f"{file} is missing")
        try:
            size, digest = file.stat().st_size, files.sha256(file)
        except OSError as error:
            raise DamagedCheckpoint(f"{file} cannot be read ({error})") from error
        if size != expected["bytes"]:
            raise DamagedCheckpoint(f"{file} has {size} bytes, expected {expected['bytes']}")
        if digest != expected["sha256"]:
            raise DamagedCheckpoint(f"{file} has another content than was written (sha256)")
    return manifest


def path_of(directory: str | os.PathLike, step: int) -> pathlib.Path:
    return pathlib.Path(directory).absolute() / f"{_PREFIX}{step:08d}"


def _write_manifest(root: pathlib.Path, step: int, state: Any) -> None:
    hashes = {
        file.relative_to(root).as_posix(): {
            "bytes": file.stat().st_size,
            "sha256": files.sha256(file),
        }
        for file in sorted(root.rglob("*"))
        if file.is_file()
    }
    manifest = {"step": step, "files": hashes, "leaves": _leaves(state)}
    text = json.dumps({"manifest": manifest, "sha256": _hash_of_manifest(manifest)}, indent=1)
    with open(root / _MANIFEST, "w") as stream:
        stream.write(text)
        stream.flush()
        os.fsync(stream.fileno())
    files.sync_directory(root)


def _hash_of_manifest(manifest: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()


def _leaves(tree: ArrayTree) -> dict[str, str]:
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {jax.tree_util.keystr(path): f"{x.dtype}{list(x.shape)}" for path, x in leaves}


def _check_leaves(path: pathlib.Path, saved: dict[str, str], expected: dict[str, str]) -> None:
    # orbax would cast another dtype silently
    for name in sorted(saved.keys() | expected.keys()):
        if saved.get(name) != expected.get(name):
            raise ValueError(
                f"checkpoint {path} was made with other settings: {name} is "
                f"{saved.get(name, 'absent')} there, expected {expected.get(name, 'absent')}"
            )


def _abstract(leaf: jax.Array | jax.ShapeDtypeStruct) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=leaf.sharding)


def _bytes(state: Any) -> int:
    return sum(leaf.nbytes for leaf in jax.tree.leaves(state))


def _require_space(root: pathlib.Path, needed: int) -> None:
    if shutil.disk_usage(root).free < needed:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _is_disk_full(error: BaseException | None) -> bool:
    while error is not None:
        if getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT):
            return True
        if "No space left" in str(error) or "quota exceeded" in str(error):
            return True
        error = error.__cause__ or error.__context__
    return False


def _remove_leftovers(root: pathlib.Path) -> None:
    for leftover in root.glob(f"{_TEMPORARY}*"):
        shutil.rmtree(leftover, ignore_errors=True)


def _remove(path: pathlib.Path) -> None:
    # hidden first: a kill while it is emptied must not leave a damaged step
    hidden = path.with_name(f"{_TEMPORARY}old-{path.name}")
    path.rename(hidden)
    shutil.rmtree(hidden, ignore_errors=True)
