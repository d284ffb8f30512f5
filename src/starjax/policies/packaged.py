"""Trained policies that ship with the package, found by name.

weights/<name>.safetensors    in half precision, by `starjax pack`
weights/<name>.monitor.json   its runtime monitor, in place of the one in the weights
weights/<name>.json           result.json of its evaluation without the trials: nothing reads it
"""

import os
from pathlib import Path

from starjax import errors
from starjax.runtime import hub

FOLDER = Path(__file__).with_name("weights")
_SUFFIX = ".safetensors"


def names() -> list[str]:
    """Lists packaged policies."""
    return sorted(path.stem for path in FOLDER.glob(f"*{_SUFFIX}"))


def locate(name_or_path: str) -> Path:
    """Returns the packaged file of this name, else the path itself, which may not exist."""
    is_packaged = name_or_path in names()
    return FOLDER / f"{name_or_path}{_SUFFIX}" if is_packaged else Path(name_or_path)


def find(argument: str, name_or_path: str) -> Path:
    """Returns the file that `locate` names, or one of the Hub; `./name` is never a packaged one.

    Raises:
      errors.UsageError: the file of `argument` is missing or not readable.
    """
    if hub.is_name(name_or_path):
        return hub.policy(argument, name_or_path)
    path = locate(name_or_path)
    if not path.is_file():
        expected = " or one of ".join(filter(None, ["a file", ", ".join(names())]))
        near = errors.nearest(name_or_path, names())
        raise errors.UsageError(argument, expected, name_or_path or "none", near)
    if not os.access(path, os.R_OK):
        raise errors.UsageError(argument, "a file that may be read", path)
    return path
