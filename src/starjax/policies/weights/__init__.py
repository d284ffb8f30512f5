"""Weights that come with the package, one `<name>.safetensors` each in this folder, found by name.

Standard library only: settings are checked before jax loads.
"""

import importlib.resources
from pathlib import Path

_SUFFIX = ".safetensors"


def resolve(name: str) -> Path:
    """The file of packaged weights of this name, else `name` as a path; it may not exist."""
    packaged = _folder() / f"{name}{_SUFFIX}"
    return packaged if name in names() else Path(name)


def names() -> list[str]:
    """Names of the packaged weights."""
    return sorted(path.stem for path in _folder().glob(f"*{_SUFFIX}"))


def _folder() -> Path:
    # An installed package lies in a folder: jax and MuJoCo do not run from an archive either.
    return Path(str(importlib.resources.files(__name__)))
