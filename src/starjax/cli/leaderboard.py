"""`starjax leaderboard`: tabulates results by the protocol of the trocar benchmark."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from starjax.cli import checks, options
from starjax.core import errors
from starjax.runtime import xla

DESCRIPTION = """Tabulates results of evaluate, sweep and stress by task and policy.

RESULT is a result.json, sweep.json or stress.json, or a directory with such files. The flag
--benchmark of these commands runs the trials of the trocar benchmark. Results of other trials are
listed with the reason; results of another version of the benchmark, or without one, are apart.

Examples:
  starjax leaderboard runs
  starjax leaderboard runs/evaluate --markdown"""


@dataclasses.dataclass(frozen=True)
class LeaderboardArgs:
    """Flags of the command."""

    result: Annotated[  # results, or directories with them
        tuple[str, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="RESULT [RESULT ...]", help_behavior_hint="(required)"),
    ]
    json: bool = False  # print JSON: every rate with its interval
    markdown: bool = False  # print Markdown


def main(argv: Sequence[str]) -> int:
    """Prints the tables."""
    args = options.parse("leaderboard", LeaderboardArgs, argv, DESCRIPTION)
    checks.expect(bool(args.result), "RESULT", "at least one result", "none")
    checks.expect(not (args.json and args.markdown), "markdown", "not with --json", "both")
    xla.prepare_xla()
    from starjax.report import leaderboard, leaderboard_tables

    try:
        rows, others = leaderboard.read(leaderboard.find(map(Path, args.result)))
    except ValueError as error:
        if isinstance(error, errors.UsageError):
            raise
        raise errors.UsageError("RESULT", "results that are whole", error) from error
    if args.json:
        print(json.dumps(leaderboard_tables.values(rows, others), indent=1))
    else:
        draw = leaderboard_tables.markdown if args.markdown else leaderboard_tables.text
        print(errors.printable(draw(rows, others)))
    return 0
