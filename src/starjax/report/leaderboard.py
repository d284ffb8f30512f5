"""Rows of the trocar benchmark from results: a row per policy, task and robots.

An evaluation, a sweep and stresses of the same weights make one row. Results with other trials than
the protocol's make none, and the reason is given; those of another version of the benchmark, or
without one, make rows of their own.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from starjax.core import errors
from starjax.evaluation import protocol
from starjax.report import leaderboard_rows
from starjax.report.leaderboard_rows import Row

FILES = ("result.json", "sweep.json", "stress.json")  # files of a directory


class OtherTrials(NamedTuple):
    """A result with other trials than the protocol's, and the differences."""

    file: str
    reasons: tuple[str, ...]


def find(paths: Iterable[Path]) -> list[Path]:
    """Returns the results among paths: files as they are, and those within directories.

    Raises:
      errors.UsageError: there is no result at a path.
    """
    found: dict[Path, None] = {}
    for path in paths:
        within = [path] if path.is_file() else [p for name in FILES for p in path.rglob(name)]
        if not within:
            expected = f"a result, or a directory with {', '.join(FILES)}"
            raise errors.UsageError("RESULT", expected, path)
        found |= dict.fromkeys(sorted(within))
    return list(found)


def read(paths: Iterable[Path]) -> tuple[list[Row], list[OtherTrials]]:
    """Reads results; the rows are in order of the protocol's tasks, the best of each first.

    Raises:
      ValueError: a file is damaged, or no result; the message names it.
    """
    rows: dict[Any, Row] = {}
    others = []
    for path in paths:
        key, row, reasons = leaderboard_rows.of_file(path)
        if reasons:
            others.append(OtherTrials(str(path), tuple(reasons)))
        else:
            rows[key] = _merged(rows[key], row) if key in rows else row
    return sorted(rows.values(), key=_order), others


def _merged(one: Row, other: Row) -> Row:
    """Returns the row of two results; of each score the first counts."""
    commits = dict.fromkeys(filter(None, [one.commit, other.commit]))
    scores = {
        name: getattr(one, name) or getattr(other, name)
        for name in ("policy", "seen", "unseen", "others", "rcm_p99_mm")
    }
    return one._replace(
        **scores,
        stress={**other.stress, **one.stress},
        commit=", ".join(commits),
        commands=(*one.commands, *other.commands),
        files=(*one.files, *other.files),
    )


def _order(row: Row) -> tuple[Any, ...]:
    tasks = list(protocol.TIME_LIMIT_S)
    scores = [score for score in (row.seen, row.unseen) if score]
    rate = sum(s.successes for s in scores) / max(sum(s.trials for s in scores), 1)
    return -(row.version or 0), tasks.index(row.task), row.arms, -rate, row.method, row.policy
