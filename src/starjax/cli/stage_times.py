"""Durations of stages with the part of compilation, summed over all starts of a run."""

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path

import jax.monitoring

from starjax.runtime import files, precompile, processes

# Tracing does not count: its events nest, and their sum means nothing.
_COMPILE_EVENTS = (
    "/jax/core/compile/backend_compile_duration",
    "/jax/core/compile/jaxpr_to_mlir_module_duration",
)


@contextlib.contextmanager
def timed(out: Path, stage: str, resumes: bool = True) -> Iterator[None]:
    """Adds the seconds spent inside to `<out>/timings.json`, also after Ctrl-C.

    `stage` is all of them, `stage: compile` those in which jax compiled. Unless the work `resumes`
    from an earlier start, what that took does not count. Of several processes, the first one does.
    """
    if not processes.is_first():  # the first one's time is the run's
        yield
        return
    start, compiled = time.monotonic(), list[float]()
    names = (stage, f"{stage}: compile")
    before = read(out)
    if not resumes and any(name in before for name in names):  # at once: a kill leaves no chance
        kept = {name: seconds for name, seconds in before.items() if name not in names}
        files.write_json(out / "timings.json", kept)

    def note() -> None:
        spent = read(out)
        for name, seconds in zip(names, (time.monotonic() - start, sum(compiled))):
            spent[name] = round(spent.get(name, 0.0) + seconds, 2)
        files.write_json(out / "timings.json", spent)

    try:
        with _appending(compiled):
            yield
    except BaseException:
        with contextlib.suppress(OSError):  # the interrupted work reports a full disk
            note()
        raise
    note()


def read(out: Path) -> dict[str, float]:
    """Returns the seconds of each stage so far, empty for a damaged file."""
    try:
        return files.read_json(out / "timings.json")
    except (FileNotFoundError, ValueError):
        return {}


@contextlib.contextmanager
def _appending(seconds: list[float]) -> Iterator[None]:
    """Appends the durations of compilations that jax reports inside the block."""

    def add(event: str, duration_secs: float, **kwargs: str | int) -> None:
        if event in _COMPILE_EVENTS and not precompile.is_job():
            seconds.append(duration_secs)

    jax.monitoring.register_event_duration_secs_listener(add)
    try:
        yield
    finally:
        jax.monitoring.unregister_event_duration_listener(add)
