"""`starjax check NAME`: checks one part, such as one of another package."""

import dataclasses
import importlib
from collections.abc import Callable, Sequence
from typing import Annotated, Any, NamedTuple

import tyro

from starjax import config as config_lib
from starjax import errors, extensions, methods
from starjax.commands import options, presets
from starjax.learners import ENCODERS, LEARNERS
from starjax.policies.external import POLICIES
from starjax.registry import Registry, load
from starjax.runtime import jax_start, sources, xla
from starjax.sim import registries

DESCRIPTION = """Checks a part by its name in starjax list, such as one of another package.

Each line is one check: `ok`, `note` for something to look at, or `failed`. The exit code is 1 if
one failed. Where two kinds of parts share a name, KIND comes before it.

Examples:
  starjax check reach --n 100
  starjax check disturbance camera"""
_HERE = "starjax.commands.part_checks"


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


class Kind(NamedTuple):
    """One kind of part.

    Attributes:
      registry: () -> its registry, or None for cameras.
      names: () -> names.
      check: module with the checks, such as those of `part_checks`.
    """

    registry: Callable[[], Registry | None]
    names: Callable[[], list[str]]
    check: str


def main(argv: Sequence[str]) -> int:
    """Prints the checks; returns 1 if one failed."""
    args = options.parse("check", CheckArgs, argv, DESCRIPTION)
    xla.prepare_xla()  # before the module of a part starts jax
    kind, name = resolve(args.part)
    jax_start.require_devices("starjax.commands.part_checks.base")
    from starjax.commands.part_checks.base import FAILED

    print(_title(kind, name), flush=True)
    module = importlib.import_module(_kinds()[kind].check)
    count = 0
    for check in module.check(name, args.n):
        print(errors.printable(str(check)), flush=True)
        count += check.status == FAILED
    print(f"{count} failed" if count else "no fault found")
    return int(count > 0)


def resolve(words: Sequence[str]) -> tuple[str, str]:
    """Returns kind and name of the part that the command line names.

    Raises:
      errors.UsageError: there is no such part, or there are several.
    """
    kinds = _kinds()
    if len(words) == 2:
        errors.choice("KIND", words[0], kinds)
        errors.choice("NAME", words[1], kinds[words[0]].names())
        return words[0], words[1]
    if len(words) != 1:
        raise errors.UsageError("NAME", "a name, or a kind and a name", " ".join(words) or "none")
    (name,) = words
    found = [kind for kind, row in kinds.items() if name in row.names()]
    if not found:
        known = [each for row in kinds.values() for each in row.names()]
        hint = errors.nearest(name, known) or "starjax list shows all"
        raise errors.UsageError("NAME", "a part's name", repr(name), hint)
    if len(found) > 1:
        kinds_of = " or ".join(f"{kind} {name}" for kind in found)
        raise errors.UsageError("NAME", kinds_of, repr(name), "give the kind first")
    return found[0], name


def _kinds() -> dict[str, Kind]:
    from starjax.evaluation.disturbances import DISTURBANCES
    from starjax.rcm.actions import ACTION_SPACES

    def row(registry: Registry, module: str) -> Kind:
        return Kind(lambda: registry, registry.names, module)

    return {
        "task": row(registries.tasks, f"{_HERE}.tasks"),
        "arm": row(registries.arms, f"{_HERE}.arms"),
        "tool": row(registries.tools, f"{_HERE}.tools"),
        "camera": Kind(lambda: None, lambda: list(cameras()), f"{_HERE}.cameras"),
        "learner": row(LEARNERS, f"{_HERE}.learners"),
        **{name: row(load(kind.registry), kind.check) for name, kind in extensions.kinds().items()},
        "disturbance": row(DISTURBANCES, f"{_HERE}.disturbances"),
        "method": row(methods.METHODS.registry, f"{_HERE}.methods"),
        "action_space": row(ACTION_SPACES.registry, f"{_HERE}.action_spaces"),
        "preset": row(presets.PRESETS.registry, f"{_HERE}.presets"),
        "encoder": row(ENCODERS, f"{_HERE}.encoders"),
        "policy": row(POLICIES, f"{_HERE}.policies"),
    }


def cameras() -> dict[str, list[str]]:
    """Returns the tasks of each camera, without those of broken packages."""
    found: dict[str, list[str]] = {}
    for name in registries.tasks.names():
        for camera in _cameras_of(name):
            found.setdefault(camera, []).append(name)
    return found


def _cameras_of(task: str) -> Sequence[str]:
    try:
        return registries.tasks.get(task).cameras
    except errors.UsageError:
        return ()


def _title(kind: str, name: str) -> str:
    registry: Any = _kinds()[kind].registry()
    path = registry.path(name) if registry else ""
    packages = sources.packages([sources.Identity(name, 0, path)])
    versions = "".join(f", {package} {of}" for package, of in packages.items())
    return f"{kind} {name}" + f" ({path}{versions})" * bool(path)
