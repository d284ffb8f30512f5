"""`starjax train`: demonstrations and weights of a run, no evaluation."""

from collections.abc import Sequence

from starjax.commands import options, run_settings

DESCRIPTION = """Collects and trains, without evaluation (the flags are those of `starjax run`).

The same command again goes on from the last checkpoint."""


def main(argv: Sequence[str]) -> int:
    """Collects and trains what is missing."""
    config = run_settings.parse(argv, "starjax train", DESCRIPTION)
    from starjax.commands import pipeline

    pipeline.run(config, stages=("collect", "train"), command=options.typed("train", argv))
    return 0
