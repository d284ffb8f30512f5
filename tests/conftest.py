"""Settings and fixtures of every test: XLA is set up here, before anything imports jax."""

import os
import pathlib
import types
from collections.abc import Iterator

import pytest

from starjax import runtime

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("MPLBACKEND", "Agg")
runtime.prepare_xla()

import jax  # noqa: E402

from starjax.runtime import stored  # noqa: E402

stored.is_used = False  # no key sees the functions that tests replace in modules

HERE = pathlib.Path(__file__).parent
# Where numbers are compared to the last bit, or settings of jax are recorded. Elsewhere most
# programs run once, and compiling them takes longer than running them.
OPTIMIZED = {"data", "evaluation", "report", "rollouts", "runtime"}
# Modules that start processes, and the function that kills a job again and again.
STARTERS = {"pty", "several", "subprocess", "survive"}


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    is_quick = OPTIMIZED.isdisjoint(item.path.relative_to(HERE).parts[:2])
    jax.config.update("jax_disable_most_optimizations", is_quick)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests of a release or that start a process are slow; files with a slow test come first.

    So no worker ends alone with one of them.
    """
    for item in items:
        is_function = isinstance(item, pytest.Function)
        if item.get_closest_marker("release") or (is_function and starts_process(item)):
            item.add_marker("slow")
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


def starts_process(item: pytest.Function) -> bool:
    """True if a test, one of its fixtures or a function of their files names a starter."""
    fixtures = [fixture[-1].func for fixture in item._fixtureinfo.name2fixturedefs.values()]
    stack, seen = [item.function, *fixtures], set()
    while stack:
        function = stack.pop()
        if not isinstance(function, types.FunctionType) or function in seen:
            continue
        seen.add(function)
        names = set(names_in(function.__code__))
        if names & STARTERS:
            return True
        namespace = function.__globals__
        stack += [
            other
            for name in names
            if getattr(other := namespace.get(name), "__globals__", None) is namespace
        ]
    return False


def names_in(code: types.CodeType) -> Iterator[str]:
    """Yields the global and attribute names of a function and of the functions inside it."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from names_in(constant)
