"""Help of a command at the terminal's width: description, examples, and the flags used most.

Imports neither jax nor numpy.
"""

import os
import shutil
import textwrap
from collections.abc import Sequence

from starjax.core import config

SHORT, FULL = ("-h", "--help"), "--help-all"
# Settings -> fields in the short help, which has all fields of other dataclasses. Fields that hold
# settings of their own follow this table, too.
FIRST: dict[type, tuple[str, ...]] = {
    config.RunConfig: ("method", "preset", "seed", "out", "track"),
    config.SceneConfig: ("task", "arm", "camera"),
    config.DemosConfig: ("from_", "per_trocar"),
    config.PolicyConfig: ("learner", "observation"),
    config.TrainConfig: ("steps",),
    config.TrialsConfig: ("trials", "time_limit_s"),
}
_NARROWEST, _WIDTH = 20, 100  # columns


def requested(words: Sequence[str]) -> str:
    """Returns `FULL` or `SHORT[-1]` if the command line has it, else an empty string."""
    if FULL in words:
        return FULL
    return SHORT[-1] if any(word in SHORT for word in words) else ""


def first(settings: type) -> tuple[str, ...] | None:
    """Returns the fields of a dataclass in the short help, None for all."""
    return next((names for kind, names in FIRST.items() if issubclass(settings, kind)), None)


def page(flags: str, description: str, more: str) -> str:
    """Returns the help of a command.

    Args:
      flags: usage line, an empty line, and the flags.
      description: paragraphs; those with lines that begin with a space stay as they are.
      more: last line, may be empty.
    """
    usage, _, boxes = flags.partition("\n")
    parts = [usage.rstrip(), _wrapped(description), boxes.strip(), more]
    return "\n\n".join(filter(None, parts))


def widen() -> None:
    """Sets COLUMNS in a terminal too narrow for tyro, which would wrap its text for ever."""
    if shutil.get_terminal_size().columns < _NARROWEST:
        os.environ["COLUMNS"] = str(_NARROWEST)


def _wrapped(text: str) -> str:
    width = min(shutil.get_terminal_size().columns, _WIDTH)
    return "\n\n".join(_paragraph(part, width) for part in text.strip().split("\n\n"))


def _paragraph(text: str, width: int) -> str:
    if any(line.startswith(" ") for line in text.splitlines()):
        return text
    # A command or a path stays whole.
    return textwrap.fill(text, width, break_long_words=False, break_on_hyphens=False)
