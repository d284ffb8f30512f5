"""Trained policies by name: one of starjax itself, the others of `starjax-weights`.

<name>.safetensors           in half precision, by `starjax pack`
<name>.monitor.json          its runtime monitor, in place of the one in the weights
<name>.json                  result.json of its evaluation without the trials, for `starjax list`
<name>.encoder.safetensors   its image encoder alone, of a policy that presets start from

A checkout's folder `weights/` is the distribution; it need not be installed.
"""

import importlib.resources
import importlib.util
import os
from pathlib import Path

from starjax.core import errors, extensions
from starjax.runtime import hub

FOLDER = Path(__file__).with_name("weights")
PACKAGE = "starjax_weights"
CHECKOUT = Path(__file__).parents[3] / "weights"
# Policies of the core's tasks; those of add-ons' tasks are in their tables.
CORE = (
    "compact", "demo", "needle_handover", "needle_pick", "peg_transfer_bimanual",
    "peg_transfer_robust",
)  # fmt: skip
_SUFFIX = ".safetensors"
_INSTALL = "in a checkout of starjax: pip install -e ./weights"


def folders() -> list[Path]:
    """Returns the folders with policies that are here: starjax's own, the distribution's."""
    if importlib.util.find_spec(PACKAGE) is not None:
        return [FOLDER, Path(str(importlib.resources.files(PACKAGE)))]
    return [FOLDER, CHECKOUT / PACKAGE]


def names() -> list[str]:
    """Lists the policies that are here."""
    return [name for name in _known() if _file(name).is_file()]


def locate(name_or_path: str) -> Path:
    """Returns the file of this policy, else the path itself, which may not exist."""
    return _file(name_or_path) if name_or_path in names() else Path(name_or_path)


def is_packaged(path: Path) -> bool:
    """Returns True for the file of a policy that has a name."""
    return path.parent in folders() and path.stem in _known()


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
        hint = _INSTALL if name_or_path in _known() else errors.nearest(name_or_path, _known())
        raise errors.UsageError(argument, expected, name_or_path or "none", hint)
    if not os.access(path, os.R_OK):
        raise errors.UsageError(argument, "a file that may be read", path)
    return path


def find_encoder(argument: str, name_or_path: str) -> Path:
    """Returns a file with an image encoder: that of a name alone if starjax has it, else `find`."""
    alone = folders()[0] / f"{name_or_path}.encoder{_SUFFIX}"
    is_alone = name_or_path in _known() and alone.is_file()
    return alone if is_alone else find(argument, name_or_path)


def _known() -> list[str]:
    return sorted((*CORE, *extensions.policies()))


def _file(name: str) -> Path:
    """Returns the file of a policy; without one, the path that starjax's own would have."""
    files = [folder / f"{name}{_SUFFIX}" for folder in folders()]
    return next((file for file in files if file.is_file()), files[0])
