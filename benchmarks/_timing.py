"""Parts of every benchmark: measurement of a time, provenance of a result file.

A time is the median of repeated calls, each waited for; compilation is timed apart, and a peer
is timed in the same process, so a ratio means something on a busy or a slow machine.
"""

import json
import pathlib
import shlex
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from starjax.runtime import files, provenance, xla

RESULTS = pathlib.Path(__file__).parent / "results"


class Timing(NamedTuple):
    """What is known of a program.

    Attributes:
      compile_s: ahead-of-time compilation (or reading it from the persistent cache), seconds.
      median_s: of one call, over the repeats; min_s: the fastest.
      temporary_bytes: the compiler's scratch memory, without inputs and results.
      result_bytes: its results that do not reuse an input's memory.
      cores: CPU time of this process over wall time. A program of several threads is slower where
        others take the cores: times of different numbers do not compare.
    """

    compile_s: float
    median_s: float
    min_s: float
    temporary_bytes: int = 0
    result_bytes: int = 0
    cores: float = 0.0


def time_jitted(function: Callable, *arguments: Any, repeats: int = 7) -> Timing:
    """Compile `function` for `arguments`, then time calls until their results are ready."""
    compiled, known = _compile(function, arguments)
    arguments = jax.device_put(arguments)
    timing = time_plain(lambda: jax.block_until_ready(compiled(*arguments)), repeats=repeats)
    return known._replace(median_s=timing.median_s, min_s=timing.min_s)


def time_carried(
    function: Callable,
    carry: Any,
    *arguments: Any,
    repeats: int = 5,
    calls: int = 1,
    **options: Any,
) -> tuple[Timing, Any]:
    """The same of `(carry, *arguments) -> carry`, each call on the last one's memory.

    Times are of `calls` calls, of which the last is waited for. Returns the timing and the last
    carry; the given one stays as it is. `options` are jit's.
    """
    # Copied: a buffer that stands in it twice could not be given away.
    carry = jax.tree.map(jnp.copy, carry)
    compiled, known = _compile(function, (carry, *arguments), donate_argnums=0, **options)

    def call():
        nonlocal carry
        for _ in range(calls):
            carry = compiled(carry, *arguments)
        jax.block_until_ready(carry)

    timing = time_plain(call, repeats=repeats)
    return known._replace(median_s=timing.median_s, min_s=timing.min_s), carry


def _compile(function: Callable, arguments: tuple, **options: Any) -> tuple[Any, Timing]:
    start = time.perf_counter()
    # A new function object: one that was called before would come out of jit's cache.
    program = jax.jit(lambda *inputs: function(*inputs), **options)
    compiled = program.lower(*arguments).compile()
    compile_s = time.perf_counter() - start
    memory = compiled.memory_analysis()
    temporary = getattr(memory, "temp_size_in_bytes", 0)
    result = getattr(memory, "output_size_in_bytes", 0) - getattr(memory, "alias_size_in_bytes", 0)
    return compiled, Timing(compile_s, 0.0, 0.0, temporary, result)


def time_plain(function: Callable[[], Any], repeats: int = 7) -> Timing:
    """Time calls of a function that returns when it is done, after one that is not counted."""
    function()
    seconds, cpu_start = [], time.process_time()
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        seconds.append(time.perf_counter() - start)
    cores = (time.process_time() - cpu_start) / sum(seconds)
    return Timing(0.0, statistics.median(seconds), min(seconds), cores=cores)


def time_once(function: Callable[[], Any]) -> float:
    """Seconds of one call that waits for its work itself."""
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def rounded(value: Any) -> Any:
    """`value` with every float at four significant digits, at any depth."""
    if isinstance(value, dict):
        return {key: rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(item) for item in value]
    return float(f"{value:.4g}") if isinstance(value, float) else value


def write(name: str, results: dict[str, Any]) -> pathlib.Path:
    """Write `results/<name>_<backend>.json`: figures, with code, command and machine.

    Rows (`results["results"]`) measured before with the same versions on the same kind of device,
    of a CPU the same number of the same cores, stay: a benchmark may be run row by row;
    `made` has the code and command of each.
    """
    path = RESULTS / f"{name}_{jax.default_backend()}.json"
    path.parent.mkdir(exist_ok=True)
    machine = {"versions": xla.versions(), "hardware": xla.hardware()}
    new = {"benchmark": name, **rounded(results), "made": _made_by(), **machine}
    before = json.loads(path.read_text()) if path.exists() else {}
    if "results" in new:
        new["made"] = dict.fromkeys(new["results"], new["made"])
        if _made_with(before) == _made_with(new):
            new |= {part: {**before.get(part, {}), **new[part]} for part in ("results", "made")}
    files.write_json(path, new)
    return path


def report(name: str, results: dict[str, Any], tiny: bool) -> None:
    """`write`, unless the sizes were only for a test."""
    print("a test's sizes: nothing is written" if tiny else f"wrote {write(name, results)}")


def _made_by() -> dict[str, Any]:
    code = provenance.code()
    command = shlex.join(["python", f"benchmarks/{pathlib.Path(sys.argv[0]).name}", *sys.argv[1:]])
    return {"commit": code.commit, "dirty": code.dirty, "command": command}


def _made_with(found: dict[str, Any]) -> Any:
    hardware = found.get("hardware", {})
    device = ("cpu", "cores") if hardware.get("backend") == "cpu" else ()
    host = [hardware.get(name) for name in device]
    return found.get("versions"), set(hardware.get("devices", [])), host
