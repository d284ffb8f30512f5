"""Kinds of parts, and the module with the checks of each."""

import importlib
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

from starjax.cli import presets
from starjax.core import errors, extensions, methods
from starjax.core.learners import ENCODERS, LEARNERS
from starjax.core.registry import Registry, load
from starjax.policies.external import POLICIES
from starjax.sim import registries

if TYPE_CHECKING:
    from starjax.testing.base import Check

_HERE = "starjax.testing"


class Kind(NamedTuple):
    """One kind of part.

    Attributes:
      registry: () -> its registry, or None for cameras.
      names: () -> names.
      check: module with the checks, (name, episodes) -> Checks.
    """

    registry: Callable[[], Registry | None]
    names: Callable[[], list[str]]
    check: str


def run(kind: str, name: str, n: int) -> Iterator["Check"]:
    """Yields the checks of a part; an exception of its code is a fault too.

    Args:
      n: episodes of each expert of a task.
    """
    from starjax.testing import base

    try:
        yield from importlib.import_module(kinds()[kind].check).check(name, n)
    # Code of the part may raise anything, even end the process.
    except (Exception, SystemExit) as error:
        yield base.failed("checks", base.raised(error))


def kinds() -> dict[str, Kind]:
    """Returns the kinds by name."""
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
