"""The command `starjax run`, also `python -m starjax.experiments.run`: from trocar to table."""

from collections.abc import Sequence

DESCRIPTION = """Collects demonstrations, trains, evaluates and writes the report.

The same command again goes on from what is saved. Values below are those of the chosen preset."""


def main(argv: Sequence[str]) -> int:
    """Runs every stage that is not already done."""
    # Imported late: `--help` and mistakes answer before jax loads, and missing packages before all.
    from starjax.commands import options, run_settings

    config = run_settings.parse(argv, "starjax run", DESCRIPTION)
    from starjax.commands import pipeline

    pipeline.run(config, pipeline.STAGES, options.typed("run", argv))
    return 0
