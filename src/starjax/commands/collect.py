"""`starjax collect`: the demonstrations of a run and nothing else."""

from collections.abc import Sequence

from starjax.commands import options, run_settings

DESCRIPTION = """Collects the demonstrations of a run (the flags are those of `starjax run`).

Episodes are committed one by one: the same command again goes on from what is there."""


def main(argv: Sequence[str]) -> int:
    """Collects what is missing."""
    config = run_settings.parse(argv, "starjax collect", DESCRIPTION)
    from starjax.commands import pipeline

    pipeline.run(config, stages=("collect",), command=options.typed("collect", argv))
    return 0
