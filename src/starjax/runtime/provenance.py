"""Origin of the running code: a commit of its checkout, or the record of its installation."""

import functools
import importlib.metadata
import json
import re
import subprocess
from pathlib import Path
from typing import NamedTuple

_PACKAGE = Path(__file__).parents[1]
_TIMEOUT_S = 10.0  # for git, which may wait for a network's file system


class Code(NamedTuple):
    """The code that runs.

    Attributes:
      version: of the package.
      commit: hexadecimal, None where neither a checkout nor the installation says it.
      dirty: True if the package's tracked files differ from the commit, None without one.
    """

    version: str
    commit: str | None
    dirty: bool | None


@functools.cache
def code() -> Code:
    """Returns the code of this process, as of the first call. Never fails."""
    try:
        version = importlib.metadata.version("starjax")
    except importlib.metadata.PackageNotFoundError:
        from starjax import __version__ as version
    commit = _of_checkout(_PACKAGE) or _of_origin() or of_version(version)
    return Code(version, *(commit or (None, None)))


def of_version(version: str) -> tuple[str, bool] | None:
    """Reads commit and dirty flag of a version made from git tags: `1.2.dev3+g0a1b2c3.d2025`."""
    match = re.search(r"\+g([0-9a-f]{7,40})(\.d\d+)?$", version)
    return (match[1], bool(match[2])) if match else None


def _of_checkout(package: Path) -> tuple[str, bool] | None:
    """Returns commit and dirty flag from git, if it tracks the package.

    The package may also lie untracked in another repository.
    """

    def git(*words: str) -> str:
        command = ["git", "-C", str(package), *words]
        done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT_S)
        done.check_returncode()
        return done.stdout.strip()

    try:
        git("ls-files", "--error-unmatch", "__init__.py")
        changed = git("status", "--porcelain", "--untracked-files=no", "--", ".", ":/mjcf")
        return git("rev-parse", "HEAD"), bool(changed)
    except (OSError, subprocess.SubprocessError):
        return None


def _of_origin() -> tuple[str, bool] | None:
    """Returns the commit that an installation from a repository records (PEP 610)."""
    try:
        record = importlib.metadata.distribution("starjax").read_text("direct_url.json")
        return str(json.loads(record or "")["vcs_info"]["commit_id"]), False
    except (importlib.metadata.PackageNotFoundError, ValueError, KeyError, TypeError):
        return None
