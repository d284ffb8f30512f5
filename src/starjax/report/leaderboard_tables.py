"""Rows of the trocar benchmark as Markdown, plain text and JSON values."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from starjax.evaluation import protocol
from starjax.report import formats, stats
from starjax.report.leaderboard import OtherTrials, Row
from starjax.sim import registries

NONE = "\u2013"  # a score without a result
_Render = Callable[[formats.Table, int], str]
_NAMES = 3  # columns of names, before those of scores


def current(rows: Sequence[Row]) -> list[Row]:
    """Returns the rows of this version of the benchmark."""
    return [row for row in rows if row.version == protocol.VERSION]


def apart(rows: Sequence[Row]) -> list[Row]:
    """Returns the rows of another version, or of none."""
    return [row for row in rows if row.version != protocol.VERSION]


def reason(rows: Sequence[Row]) -> str:
    """Returns a sentence about rows of another version or of none."""
    versions = sorted({row.version for row in rows}, key=lambda version: version or 0)
    named = " or ".join(f"with version {v}" if v else "without a version" for v in versions)
    return f"Recorded {named}, not with version {protocol.VERSION}: not comparable with its rows."


def table(rows: Sequence[Row]) -> formats.Table:
    """Makes a line per row, with the number of its commands in `commands`; no empty columns."""
    header = ["Task", "Method", "Policy", "Seen (%)", "Unseen (%)", "Other trocars (%)"]
    header += ["RCM p99 (mm)", "Stressed (%)", "Commit", "Command"]
    lines = [header]
    for row, number in zip(rows, _numbers(rows), strict=True):
        rcm = NONE if row.rcm_p99_mm is None else formats.millimetres(row.rcm_p99_mm)
        scores = map(_rate, (row.seen, row.unseen, row.others))
        names = _task(row), row.method, _policy(row)
        lines.append([*names, *scores, rcm, _rate(row.stressed), row.commit or NONE, str(number)])
    filled = [any(cell != NONE for cell in cells[1:]) for cells in zip(*lines, strict=True)]
    return [list(itertools.compress(line, filled)) for line in lines]


def commands(rows: Sequence[Row]) -> list[str]:
    """Returns the command lines that the last column of `table` counts, from 1."""
    return list(dict.fromkeys("; ".join(row.commands) for row in rows))


def stress_table(rows: Sequence[Row]) -> formats.Table:
    """Makes a line per disturbance, a column per row with stresses; empty without any."""
    stressed = [row for row in rows if row.stress]
    names = [name for name in protocol.STRESS if any(name in row.stress for row in stressed)]
    header = [" ".join([_task(row), row.method]) for row in stressed]
    lines = [
        [f"{name} {protocol.STRESS[name]:g}", *(_rate(row.stress.get(name)) for row in stressed)]
        for name in names
    ]
    return [["Disturbance", *header], *lines] if lines else []


def markdown(rows: Sequence[Row], others: Sequence[OtherTrials]) -> str:
    """Renders rows as tables with their commands; then other versions and trials."""
    return _page(rows, others, formats.render, "## ", "`")


def text(rows: Sequence[Row], others: Sequence[OtherTrials]) -> str:
    """Renders the same with aligned columns, for a terminal."""
    return _page(rows, others, _aligned, "", "")


def values(rows: Sequence[Row], others: Sequence[OtherTrials]) -> dict[str, Any]:
    """Returns both as JSON values, rates as {successes, trials, rate, low, high}."""
    return {
        "benchmark_version": protocol.VERSION,
        "rows": [_plain(row) for row in rows],
        "other_trials": [_plain(result) for result in others],
    }


def body(rows: Sequence[Row], render: _Render = formats.render, code: str = "`") -> str:
    """Renders a table of rows, their stresses, and the numbered commands."""
    parts = [render(table(rows), _NAMES)]
    if stressed := stress_table(rows):
        parts.append(render(stressed, 1))
    listed = enumerate(commands(rows), 1)
    parts.append("\n".join(f"{number}. {code}{command}{code}" for number, command in listed))
    return "\n\n".join(parts)


def _page(
    rows: Sequence[Row],
    others: Sequence[OtherTrials],
    render: _Render,
    heading: str,
    code: str,
) -> str:
    parts = [f"{heading}Trocar benchmark, version {protocol.VERSION}"]
    ours, older = current(rows), apart(rows)
    parts.append(body(ours, render, code) if ours else "No result.")
    if older:
        parts += [f"{heading}Apart", reason(older), body(older, render, code)]
    if others:
        lines = [f"- {result.file}: {'; '.join(result.reasons)}" for result in others]
        parts += [f"{heading}Other trials", "\n".join(lines)]
    return "\n\n".join(parts)


def _numbers(rows: Sequence[Row]) -> list[int]:
    known = commands(rows)
    return [known.index("; ".join(row.commands)) + 1 for row in rows]


def _task(row: Row) -> str:
    """Returns the task's name, with the robots if they are not its own."""
    slots = registries.tasks.get(row.task).slots
    own = row.arms == tuple(slot.arm for slot in slots)
    return row.task if own else f"{row.task}, {' '.join(row.arms)}"


def _policy(row: Row) -> str:
    return row.policy or f"weights {row.weights}"


def _rate(score: stats.Rate | None) -> str:
    return formats.rate(score) if score else NONE


def _aligned(table: formats.Table, names: int) -> str:
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    lines = [
        "  ".join(
            cell.ljust(width) if i < names else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        )
        for line in table
    ]
    return "\n".join(line.rstrip() for line in lines)


def _plain(value: Any) -> Any:
    """Returns named tuples as JSON objects, at any depth."""
    if hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, Mapping):
        return {name: _plain(part) for name, part in value.items()}
    return value
