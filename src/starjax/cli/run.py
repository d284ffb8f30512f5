"""`starjax run`, `collect` and `train`: the stages of a run, from demonstrations to the report."""

from collections.abc import Sequence

from starjax.cli import options, run_settings, session

DESCRIPTION = """Collects demonstrations, trains, evaluates and writes the report.

Rerun the same command to resume. The defaults below are those of the selected preset.

Examples:
  starjax run --preset smoke
  starjax run --task reach --policy.observation state --seed 1"""
COLLECT = """Collects the demonstrations of a run; the flags are those of `starjax run`.

Episodes are saved one by one; rerun the same command to resume.

Examples:
  starjax collect --preset cpu
  starjax collect --task needle_pick --demos.randomise breathing=0.01 --out runs/needle"""
TRAIN = """Collects demonstrations and trains; the flags are those of `starjax run`.

Rerun the same command to resume from the last checkpoint.

Examples:
  starjax train --preset cpu
  starjax train --demos.from runs/hand --policy.learner act --out runs/act"""


def main(argv: Sequence[str]) -> int:
    """Runs every stage that is not complete."""
    return _run("run", argv, DESCRIPTION, ("collect", "train", "evaluate", "report"))


def collect(argv: Sequence[str]) -> int:
    """Collects missing demonstrations."""
    return _run("collect", argv, COLLECT, ("collect",))


def train(argv: Sequence[str]) -> int:
    """Collects missing demonstrations and trains missing weights."""
    return _run("train", argv, TRAIN, ("collect", "train"))


def _run(name: str, argv: Sequence[str], description: str, stages: Sequence[str]) -> int:
    config = run_settings.parse(name, argv, description)
    session.start_run(config)
    from starjax.cli import pipeline  # it imports jax, for which mistakes do not wait

    pipeline.run(config, stages, options.typed(name, argv), run_settings.tracker(argv))
    return 0
