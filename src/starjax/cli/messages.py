"""Texts of a run for its user: the stages, the outcome."""

import contextlib
import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from starjax.core import errors, methods
from starjax.runtime import files

STAGES = ("collect", "train", "evaluate", "report")


def outcome(results: Sequence[Any]) -> str:
    """Returns a table of success at seen and unseen trocars, one line per `result.Result`."""
    rows = [("success [95% interval]", "seen", "unseen", "safe", "RCM executed")]
    for result in results:
        figures = result.figures
        error = figures["rcm_error_mm"]["executed"]
        rows.append(
            (
                methods.SCORED[result.method].label,
                rate(figures["seen"]),
                rate(figures["unseen"]),
                rate(figures["safe"]["all"]),
                f"{error['mean']:.3f} mm, at most {error['max']:.3f}",
            )
        )
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return "\n".join(
        "  " + "  ".join(f"{cell:{width}}" for cell, width in zip(row, widths)).rstrip()
        for row in rows
    )


def alarms(figures: Mapping[str, Any]) -> str:
    """Returns a line with the figures of `alarms.compose`."""
    early, false, silent = (figures[name] for name in ("before_clock", "false_alarms", "silent"))
    median = "" if figures["median_s"] is None else f", median {figures['median_s']:.1f} s"
    return (
        f"alarms: {early['successes']}/{early['trials']} failures before "
        f"{figures['clock_s']:.1f} s{median}; {false['successes']}/{false['trials']} successes; "
        f"success without alarm {rate(silent)}"
    )


def hint(run: Path, weights: str, does: str) -> str:
    """Returns the command that `does` something with these weights' figures in a directory."""
    try:
        scored = files.read_json(run / "result.json").get("weights", weights)
    except (FileNotFoundError, ValueError):
        scored = None
    typed = f"starjax report {shlex.quote(str(run))} {does} it"
    return typed if scored == weights else f"{typed} once starjax run has scored these weights"


@contextlib.contextmanager
def first_process_only(is_first: bool) -> Iterator[None]:
    """Silences all but the first process."""
    with open(os.devnull, "w") as nowhere, contextlib.ExitStack() as changed:
        if not is_first:
            changed.enter_context(contextlib.redirect_stdout(nowhere))
        yield


def stage(name: str, text: str) -> None:
    """Prints the line that begins a stage."""
    print(f"\n[{STAGES.index(name) + 1}/{len(STAGES)}] {name}: {text}", flush=True)


def indented(text: str) -> None:
    """Prints a line that belongs to the stage above it."""
    print(errors.printable(f"      {text}"), flush=True)


def rate(counted: Mapping[str, Any]) -> str:
    """Returns a rate of `statistics.rate`: its count, percent and 95% interval."""
    if not counted["trials"]:
        return "-"
    low, high = (100 * bound for bound in counted["ci95"])
    count = f"{counted['successes']}/{counted['trials']}"
    return f"{count} = {100 * counted['rate']:.0f}% [{low:.0f}, {high:.0f}]"
