"""Weights that come with the package, one `<name>.safetensors` each in this folder, found by name.

Standard library only: settings are checked before jax loads.
"""

import importlib.resources
from pathlib import Path

from starjax import config

_SUFFIX = ".safetensors"


def resolve(name: str) -> Path:
    """The file of packaged weights of this name, else `name` as a path; it may not exist."""
    return _folder() / f"{name}{_SUFFIX}" if name in names() else Path(name)


def find(argument: str, name: str) -> Path:
    """The file that `resolve` names.

    Raises:
      config.UsageError: there is none; the message begins with `argument`.
    """
    path = resolve(name)
    if not path.is_file():
        known = ", ".join([*names(), "a file"])
        raise config.UsageError(f"{argument}: expected {known.replace(', a', ' or a')}, got {name}")
    return path


def names() -> list[str]:
    """Names of the packaged weights."""
    return sorted(path.stem for path in _folder().glob(f"*{_SUFFIX}"))


def _folder() -> Path:
    # An installed package lies in a folder: jax and MuJoCo do not run from an archive either.
    return Path(str(importlib.resources.files(__name__)))
