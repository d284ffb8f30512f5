"""`starjax check NAME`: checks one part, such as one of another package."""

import dataclasses
from collections.abc import Sequence
from typing import Annotated, Any

import tyro

from starjax.cli import options
from starjax.core import config as config_lib
from starjax.core import errors, sources
from starjax.runtime import jax_start, xla
from starjax.testing import kinds

DESCRIPTION = """Checks a part by its name in starjax list, such as one of another package.

Each line is one check: `ok`, `note` for something to look at, or `failed`. The exit code is 1 if
one failed. Where two kinds of parts share a name, KIND comes before it.

Examples:
  starjax check reach --n 100
  starjax check disturbance camera"""


@dataclasses.dataclass(frozen=True)
class CheckArgs:
    """Flags of the command."""

    # kind, one of starjax list such as task or learner, then the name
    part: Annotated[
        tuple[str, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="[KIND] NAME", help_behavior_hint="(required)"),
    ]
    n: config_lib.Count = 16  # episodes of each expert of a task


def main(argv: Sequence[str]) -> int:
    """Prints the checks; returns 1 if one failed."""
    args = options.parse("check", CheckArgs, argv, DESCRIPTION)
    xla.prepare_xla()  # before the module of a part starts jax
    kind, name = resolve(args.part)
    jax_start.require_devices("starjax.testing.base")
    from starjax.testing.base import FAILED

    print(_title(kind, name), flush=True)
    count = 0
    for check in kinds.run(kind, name, args.n):
        print(errors.printable(str(check)), flush=True)
        count += check.status == FAILED
    print(f"{count} failed" if count else "no fault found")
    return int(count > 0)


def resolve(words: Sequence[str]) -> tuple[str, str]:
    """Returns kind and name of the part that the command line names.

    Raises:
      errors.UsageError: there is no such part, or there are several.
    """
    known = kinds.kinds()
    if len(words) == 2:
        errors.choice("KIND", words[0], known)
        errors.choice("NAME", words[1], known[words[0]].names())
        return words[0], words[1]
    if len(words) != 1:
        raise errors.UsageError("NAME", "a name, or a kind and a name", " ".join(words) or "none")
    (name,) = words
    found = [kind for kind, row in known.items() if name in row.names()]
    if not found:
        names = [each for row in known.values() for each in row.names()]
        hint = errors.nearest(name, names) or "starjax list shows all; is its package installed?"
        raise errors.UsageError("NAME", "a part's name", repr(name), hint)
    if len(found) > 1:
        kinds_of = " or ".join(f"{kind} {name}" for kind in found)
        raise errors.UsageError("NAME", kinds_of, repr(name), "give the kind first")
    return found[0], name


def _title(kind: str, name: str) -> str:
    registry: Any = kinds.kinds()[kind].registry()
    path = registry.path(name) if registry else ""
    packages = sources.packages([sources.Identity(name, 0, path)])
    versions = "".join(f", {package} {of}" for package, of in packages.items())
    return f"{kind} {name}" + f" ({path}{versions})" * bool(path)
