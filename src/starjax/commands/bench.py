"""`starjax bench`: measures the inference latency of a trained policy (Table IV)."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from starjax.commands import checks, folders, messages, options, session
from starjax.limits import MOST, Count, Range

DESCRIPTION = """Times one inference at batch size 1, from observation to commands, once compiled.

RUN is the directory of a method, such as runs/cpu/stardiff. The report draws Table IV from
RUN/bench.json.

Examples:
  starjax bench runs/cpu/stardiff
  starjax bench runs/paper/stardiff --ddim-steps 5 10 100"""

DDIM_STEPS = (1, 2, 5, 10, 20, 50, 100)  # of Table IV


@dataclasses.dataclass(frozen=True)
class BenchArgs:
    """Flags of the command."""

    run: options.Run  # directory of a method, such as runs/cpu/stardiff
    # numbers of denoising steps to time; default: Table IV's 1 2 5 10 20 50 100
    ddim_steps: Annotated[tuple[int, ...], Range(1, MOST)] = ()
    calls: Count = 100  # timed inferences per number of steps, fewer if they exceed 10 s


def main(argv: Sequence[str]) -> int:
    """Measures and prints latencies; writes bench.json."""
    args = options.parse("bench", BenchArgs, argv, DESCRIPTION)
    run = folders.existing(args.run)
    policy = folders.read_config(run).policy
    expected = "a method's directory of the learner diffusion"
    checks.expect(policy.learner == "diffusion", "RUN", expected, f"one of {policy.learner}")
    limit = policy.options.diffusion_steps
    for count in args.ddim_steps:
        checks.expect(count <= limit, "--ddim-steps", f"1 to {limit}", count)
    counts = args.ddim_steps or tuple(count for count in DDIM_STEPS if count <= limit)
    started = session.start("bench", argv, run)
    try:
        figures = _time(run, counts, args.calls)
    except KeyboardInterrupt:
        raise KeyboardInterrupt("stopped; bench saves its figures only at its end") from None
    file = started.write("bench.json", {"method": run.name, **figures})
    print(f"\nresult: {file}; {messages.hint(run, figures['weights'], 'shows')}")
    return 0


def _time(run: Path, counts: Sequence[int], calls: int) -> dict[str, Any]:
    """Prints and returns the rows of Table IV."""
    from starjax import methods
    from starjax.commands import policy_evaluation
    from starjax.evaluation import latency
    from starjax.policies import features

    who = policy_evaluation.load(run.name, folders.weights(run.parent, run.name))
    trained = who.trained
    sensors = features.select_sensors(who.env.task, trained.scene.cameras)
    print("  DDIM steps      p50      p95      p99 ms       Hz")
    figures = {}
    rows = latency.table(
        methods.METHODS[run.name],
        trained.policy,
        trained.params,
        trained.normalizer,
        sensors,
        ddim_steps=counts,
        calls=calls,
    )
    for row in rows:
        count = str(row["ddim_steps"])  # keys of JSON are strings
        figures[count] = row
        print(_row(count, row), flush=True)
    roll = None
    if methods.METHODS[run.name].hierarchical:
        roll = latency.roll_ms(trained.policy, sensors, calls=calls)
        print(_row("roll net", roll))
    return {
        "weights": who.weights,
        "inference_ms_by_ddim_steps": figures,
        "roll_network_ms": roll,
    }


def _row(name: str, ms: dict[str, float]) -> str:
    times = " ".join(f"{ms[key]:8.3f}" for key in ("p50", "p95", "p99"))
    return f"  {name:10} {times}    {1e3 / ms['p50']:8.1f}"
