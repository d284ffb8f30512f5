"""Settings and fixtures of every test: XLA is set up here, before anything imports jax."""

import os
import pathlib

import pytest

from starjax import runtime

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("MPLBACKEND", "Agg")
runtime.prepare_xla()

import jax  # noqa: E402

HERE = pathlib.Path(__file__).parent
# Where numbers are compared to the last bit, or settings of jax are recorded. Elsewhere most
# programs run once, and compiling them takes longer than running them.
OPTIMIZED = {"data", "evaluation", "report", "rollouts", "runtime"}


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    is_quick = item.path.relative_to(HERE).parts[0] not in OPTIMIZED
    jax.config.update("jax_disable_most_optimizations", is_quick)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with a slow test come first, so that no worker ends alone with one of them."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)
