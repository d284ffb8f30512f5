"""Datasets and policies of the Hugging Face Hub by name: `hf://user/repo[@revision][/file]`.

A revision is a tag, a commit, a branch or a pull request, as `refs/pr/3`.
The Hub's library downloads into its cache, so a name is fetched once; HF_TOKEN, HF_HOME and
HF_HUB_OFFLINE are its own variables. Nothing of a repository is executed.
"""

import glob
import importlib
import importlib.util
import re
from pathlib import Path
from typing import Any, NamedTuple

from starjax.core import errors, extras

SCHEME = "hf://"
_LIBRARY = "huggingface_hub"
POLICY_FILE = "policy.safetensors"  # for a repository whose name ends without a file
_PART = r"[\w][\w.\-]*"
# A slash in a branch's name is written %2F, as the Hub's library does.
_REVISION = r"refs/(?:pr|convert)/[\w.\-]+|(?:[\w.\-]|%2F)+"
_NAME = re.compile(rf"hf://(datasets/)?({_PART}/{_PART})(?:@({_REVISION}))?(?:/(.+))?")
_MAX_TEXT = 200  # characters of the library's error
_EXPECTED = "hf://user/repo, optionally with @revision and /file"


class HubName(NamedTuple):
    """Parts of a name: repository, revision (empty: main), file within it (may be empty)."""

    repo: str
    revision: str
    file: str
    is_dataset: bool


def is_name(text: str) -> bool:
    """Returns True for a name of the Hub."""
    return text.startswith(SCHEME)


def parse(argument: str, text: str) -> HubName:
    """Parses a name.

    Raises:
      errors.UsageError: it has another form.
    """
    match = _NAME.fullmatch(text)
    parts = (match[4] or "").split("/") if match else []
    if match is None or ".." in parts:
        raise errors.UsageError(argument, _EXPECTED, text)
    revision, file = (match[3] or "").replace("%2F", "/"), (match[4] or "").strip("/")
    return HubName(match[2], revision, file, bool(match[1]))


def policy(argument: str, text: str) -> Path:
    """Returns the local file of a policy, `POLICY_FILE` unless the name ends with a file.

    Raises:
      errors.UsageError: a wrong name, no such repository or file, or no connection.
    """
    name = parse(argument, text)
    kind = "dataset" if name.is_dataset else "model"
    file = {"filename": name.file or POLICY_FILE}
    return _fetched(argument, text, "hf_hub_download", name, kind, **file)


def dataset(argument: str, text: str) -> Path:
    """Returns the local directory of a dataset, or of the part of it that the name ends with.

    Nothing else is downloaded. Plain paths are returned as such.

    Raises:
      errors.UsageError: as of `policy`.
    """
    if not is_name(text):
        return Path(text)
    name = parse(argument, text)
    part = glob.escape(name.file)
    only = {"allow_patterns": [part, f"{part}/*"]} if part else {}
    path = _fetched(argument, text, "snapshot_download", name, "dataset", **only) / name.file
    if not path.exists():
        raise errors.UsageError(argument, "a file or folder of the dataset", text)
    return path


def _fetched(
    argument: str, text: str, function: str, name: HubName, kind: str, **part: Any
) -> Path:
    """Downloads the `part` of a repository that a function of the library has arguments for."""
    if importlib.util.find_spec(_LIBRARY) is None:
        hint = extras.install("hub")
        raise errors.UsageError(argument, f"{_LIBRARY} to be installed", "no such package", hint)
    download = getattr(importlib.import_module(_LIBRARY), function)
    try:
        path = download(name.repo, repo_type=kind, revision=name.revision or None, **part)
    # The library and those beneath it raise dozens of types: no repository, no access, no network.
    except Exception as error:
        lines = str(error).strip().splitlines() or [type(error).__name__]
        got = f"{text}: {errors.printable(lines[0])[:_MAX_TEXT]}"
        raise errors.UsageError(argument, f"a {kind} of the Hub", got) from error
    return Path(path)
