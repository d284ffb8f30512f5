"""`starjax evaluate RUN`: the twelve trocars again, other trials, seed or time limit."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import tyro

from starjax import config as config_lib
from starjax.experiments import folders, options, words
from starjax.runtime import files, xla

DESCRIPTION = """Scores a trained policy on the twelve trocars, into a folder of its own.

RUN is a method's folder, such as runs/cpu/stardiff."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Flags of the command."""

    run: tyro.conf.Positional[str]
    seed: int = 0  # of the trials
    out: str = ""  # folder of the result; RUN/evaluate-seed<seed> if empty
    eval: config_lib.EvalConfig = dataclasses.field(default_factory=config_lib.EvalConfig)


def main(argv: Sequence[str]) -> int:
    """Runs the trials that are missing and writes result.json."""
    chosen = options.parse(Options, argv, prog="starjax evaluate", description=DESCRIPTION)
    run = Path(chosen.run)
    config = dataclasses.replace(folders.read_config(run), eval=chosen.eval, seed=chosen.seed)
    folder = Path(chosen.out or run / f"evaluate-seed{chosen.seed}")
    xla.prepare_xla()
    files.require_writable(folder)

    from starjax import rcm
    from starjax.experiments import scoring

    who = scoring.subject(run.name, folders.weights(run.parent, run.name))
    table = scoring.rollouts(folder / "evaluation", who, rcm.TROCARS, chosen.eval, chosen.seed)
    result = scoring.write_result(folder, who, table, config, options.typed("evaluate", argv))
    print(f"\n{words.outcome([result])}\n\nresult: {folder / 'result.json'}")
    return 0
