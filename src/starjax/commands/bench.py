"""`starjax bench RUN`: inference latency of a trained policy (Table IV)."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from starjax.commands import checks, folders, messages, options
from starjax.limits import MOST, Count, Range
from starjax.runtime import files, xla

DESCRIPTION = """Times one decision at batch 1: observation in, commands out, compilation apart.

RUN is a method's folder, such as runs/cpu/stardiff; RUN/bench.json is what the report's Table IV
is made of."""


DDIM_STEPS = (1, 2, 5, 10, 20, 50, 100)  # of Table IV


@dataclasses.dataclass(frozen=True)
class Options:
    """Flags of the command."""

    run: options.Run  # a method's folder, such as runs/cpu/stardiff
    # numbers of denoising steps, a row for each; left out: Table IV's 1 2 5 10 20 50 100
    ddim_steps: Annotated[tuple[int, ...], Range(1, MOST)] = ()
    calls: Count = 100  # decisions timed for each, fewer if they take longer than 10 s


def main(argv: Sequence[str]) -> int:
    """Times, prints and records."""
    chosen = options.parse(Options, argv, prog="starjax bench", description=DESCRIPTION)
    run = folders.existing(chosen.run)
    config = folders.read_config(run)
    learner, expected = config.policy.learner, "a method's folder of the learner diffusion"
    checks.expect(learner == "diffusion", "RUN", expected, f"one of {learner}")
    most = config.policy.options.diffusion_steps
    for count in chosen.ddim_steps:
        checks.expect(count <= most, "--ddim-steps", f"1 to {most}", count)
    counts = chosen.ddim_steps or tuple(count for count in DDIM_STEPS if count <= most)
    files.require_writable(run)
    try:
        figures = _time(run, counts, chosen.calls)
    except KeyboardInterrupt:
        raise KeyboardInterrupt("stopped; bench saves its figures only at its end") from None
    about = {
        "method": run.name,
        "command": options.typed("bench", argv),
        "versions": xla.versions(),
        "hardware": xla.hardware(),
    }
    files.write_json(run / "bench.json", {**about, **figures})
    print(f"\nresult: {run / 'bench.json'}; {messages.hint(run, figures['weights'], 'shows')}")
    return 0


def _time(run: Path, counts: Sequence[int], calls: int) -> dict[str, Any]:
    """Times and prints; returns the rows of Table IV."""
    xla.prepare_xla()
    xla.require_devices("starjax.commands.policy_evaluation")

    from starjax import methods
    from starjax.commands import policy_evaluation
    from starjax.evaluation import latency
    from starjax.policies import features

    who = policy_evaluation.load(run.name, folders.weights(run.parent, run.name))
    trained = who.trained
    seen = features.select_sensors(who.env.task, trained.scene.cameras)
    print("  DDIM steps      p50      p95      p99 ms       Hz")
    found = {}
    rows = latency.table(
        methods.METHODS[run.name],
        trained.policy,
        trained.params,
        trained.normalizer,
        seen,
        ddim_steps=counts,
        calls=calls,
    )
    for row in rows:
        count = str(row["ddim_steps"])  # JSON's names are words
        found[count] = row
        print(_row(count, row), flush=True)
    roll = None
    if methods.METHODS[run.name].hierarchical:
        roll = latency.roll_ms(trained.policy, seen, calls=calls)
        print(_row("roll net", roll))
    return {
        "weights": who.weights,
        "inference_ms_by_ddim_steps": found,
        "roll_network_ms": roll,
    }


def _row(name: str, ms: dict[str, float]) -> str:
    times = " ".join(f"{ms[key]:8.3f}" for key in ("p50", "p95", "p99"))
    return f"  {name:10} {times}    {1e3 / ms['p50']:8.1f}"
