"""The main command, `python -m starjax.experiments.run`: from trocar to table."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from starjax import cli, errors
from starjax import config as config_lib
from starjax.experiments import checks, options, presets

DESCRIPTION = """Collects demonstrations, trains, evaluates and writes the report.

The same command again goes on from what is saved. Values below are those of the chosen preset."""


def settings(argv: Sequence[str], prog: str, description: str) -> config_lib.RunConfig:
    """Settings of a run from its command line: the preset's values under what was typed."""
    name = options.value_of("--preset", argv) or "auto"
    errors.choice("--preset", name, ["auto", *presets.PRESETS])
    default = presets.resolve(name)
    config = options.parse(
        config_lib.RunConfig, argv, prog=prog, description=description, default=default
    )
    if config.policy.observation == "state" and options.value_of("--policy.encoder-weights", argv):
        raise errors.UsageError(
            "policy.encoder_weights", "policy.observation image", config.policy.observation
        )
    if config.policy.observation == "state" and not options.is_given(
        "--policy.freeze-encoder", argv
    ):
        # A preset's encoder; one that was asked for is refused below.
        policy = dataclasses.replace(config.policy, encoder_weights="", freeze_encoder=False)
        config = dataclasses.replace(config, policy=policy)
    checks.expect_named(config.out, argv)
    out = config.out if options.is_given("--out", argv) else _folder(config, default)
    config = dataclasses.replace(config, preset=default.preset, out=out)
    checks.check(config)
    checks.expect_folder("--out", Path(out))
    return config


def _folder(config: config_lib.RunConfig, default: config_lib.RunConfig) -> str:
    """Folder of a run that names none: other observations, encoders frozen or not, and seeds have
    one each; trainings of one method that differ in anything else meet in it, and are refused."""
    policy, usual = config.policy, default.policy
    parts = [default.out]
    parts += [policy.observation] if policy.observation != usual.observation else []
    sees, freezes = policy.observation == "image", policy.freeze_encoder
    if sees and freezes != usual.freeze_encoder:
        parts.append("frozen" if freezes else "unfrozen")
    parts += [f"seed{config.seed}"] if config.seed != default.seed else []
    return "-".join(parts)


def main(argv: Sequence[str]) -> int:
    """Runs every stage that is not already done."""
    config = settings(argv, "starjax run", DESCRIPTION)
    # Imported late: `--help` and mistakes answer before jax loads.
    from starjax.experiments import pipeline

    pipeline.run(config, pipeline.STAGES, options.typed("run", argv))
    return 0


if __name__ == "__main__":
    cli.run(main)
