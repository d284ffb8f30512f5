"""What every benchmark shares: how a time is taken, and what a result file says beside it.

A time is the median of repeated calls, each waited for; compilation is timed apart, and a peer
is timed in the same process, so that a ratio means something on a busy or a slow machine.
"""

import pathlib
import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from starjax.runtime import files, xla

RESULTS = pathlib.Path(__file__).parent / "results"


class Timing(NamedTuple):
    """Seconds: ahead-of-time compilation, and one call (median and fastest of the repeats)."""

    compile_s: float
    median_s: float
    min_s: float


def time_jitted(function: Callable, *arguments: Any, repeats: int = 7) -> Timing:
    """Compile `function` for `arguments`, then time calls until their results are ready."""
    start = time.perf_counter()
    # A new function object: one that was called before would come out of jit's cache.
    compiled = jax.jit(lambda *inputs: function(*inputs)).lower(*arguments).compile()
    compile_s = time.perf_counter() - start
    arguments = jax.device_put(arguments)
    timing = time_plain(lambda: jax.block_until_ready(compiled(*arguments)), repeats=repeats)
    return timing._replace(compile_s=compile_s)


def time_plain(function: Callable[[], Any], repeats: int = 7) -> Timing:
    """Time calls of a function that returns when it is done, after one that is not counted."""
    function()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        seconds.append(time.perf_counter() - start)
    return Timing(0.0, statistics.median(seconds), min(seconds))


def rounded(value: Any) -> Any:
    """`value` with every float at four significant digits, at any depth."""
    if isinstance(value, dict):
        return {key: rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(item) for item in value]
    return float(f"{value:.4g}") if isinstance(value, float) else value


def write(name: str, results: dict[str, Any]) -> pathlib.Path:
    """Write `results/<name>_<backend>.json` with the versions and the hardware beside it."""
    path = RESULTS / f"{name}_{jax.default_backend()}.json"
    path.parent.mkdir(exist_ok=True)
    machine = {"versions": xla.versions(), "hardware": xla.hardware()}
    files.write_json(path, {"benchmark": name, **rounded(results), **machine})
    return path
