"""`starjax report`: draws tables, figures, video and page from results."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from starjax.cli import checks, options
from starjax.core import errors, methods
from starjax.evaluation import locate
from starjax.runtime import jax_start, xla

DESCRIPTION = """Writes the report of one or more runs: tables.md, figures, rollout.mp4, index.html.

RUN is the directory of a method, such as runs/cpu/stardiff, or its parent, such as runs/cpu.

Examples:
  starjax report runs/cpu
  starjax report runs/cpu/stardiff runs/gpu/stardiff --out report --no-video
  starjax report runs/cpu --against dp_rcm2"""


@dataclasses.dataclass(frozen=True)
class ReportArgs:
    """Flags of the command."""

    run: options.Runs  # directories of methods, or their parents
    # directory of the report; auto: `report` next to a method's directory or in an evaluation's
    out: str = options.AUTO
    video: bool = True  # write rollout.mp4
    # method that the others are compared with trial by trial, or all for every pair; default:
    # stardiff, or every pair without it
    against: str = ""


def main(argv: Sequence[str]) -> int:
    """Builds the report."""
    args = options.parse("report", ReportArgs, argv, DESCRIPTION)
    checks.expect(bool(args.run), "RUN", "at least one directory", "none")
    once: dict[Path, Path] = {}
    for name in args.run:
        for file in locate.results("RUN", name):
            run = file.parent if file.name == locate.RESULT else file
            once.setdefault(run.resolve(), run)
    runs = list(once.values())
    first = runs[0].resolve()
    beside = (first.parent if first.name in methods.METHODS else first) / "report"
    out = beside if args.out == options.AUTO else args.out
    checks.expect_folder("--out", out)
    xla.prepare_xla()
    jax_start.require_devices("starjax.report.build")

    from starjax.report import build

    try:
        page = build.build(runs, Path(out), with_video=args.video, against=args.against)
    except ValueError as error:  # from a damaged file, which it names
        if isinstance(error, errors.UsageError):
            raise
        raise errors.UsageError("RUN", "results that are whole", error) from error
    print(f"report: {page}")
    return 0
