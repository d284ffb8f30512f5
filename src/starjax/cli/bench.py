"""`starjax bench`: measures the inference latency of a trained policy (Table IV)."""

import dataclasses
from collections.abc import Sequence
from typing import Annotated, Any

from starjax.cli import checks, folders, messages, options, policy_args, session
from starjax.core import config as config_lib
from starjax.core.limits import MOST, Count, Range

DESCRIPTION = """Times one inference at batch size 1, from observation to commands, once compiled.

RUN is the directory of a method, such as runs/cpu/stardiff. --policy takes a policy.safetensors or
the name of a packaged policy instead. The report draws Table IV from RUN/bench.json; with --policy
the file is in a directory that the command prints.

Examples:
  starjax bench runs/cpu/stardiff
  starjax bench --policy compact --ddim-steps 5 10 100"""

DDIM_STEPS = (1, 2, 5, 10, 20, 50, 100)  # steps of Table IV


@dataclasses.dataclass(frozen=True)
class BenchArgs:
    """Flags of the command."""

    run: options.RunOrNone = ""  # directory of a method, such as runs/cpu/stardiff
    policy: str = ""  # policy.safetensors, or name of a packaged policy, instead of RUN
    # numbers of denoising steps to time; default: Table IV's 1 2 5 10 20 50 100
    ddim_steps: Annotated[tuple[int, ...], Range(1, MOST)] = ()
    calls: Count = 100  # timed inferences per number of steps, fewer if they exceed 10 s


def main(argv: Sequence[str]) -> int:
    """Measures and prints latencies; writes bench.json."""
    args = options.parse("bench", BenchArgs, argv, DESCRIPTION)
    path = policy_args.resolve(policy_args.PolicyArgs(run=args.run, policy=args.policy))
    checks.expect(not path.address, "--policy", "a file or a packaged policy", path.address)
    if path.run:
        _ddim_steps(args, folders.read_config(path.run).policy)  # mistakes come before jax
    folder = path.run or path.folder("bench", [])
    started = session.start("bench", argv, folder)
    try:
        figures = _time(args, path)
    except KeyboardInterrupt:
        raise KeyboardInterrupt("stopped; bench saves its figures only at its end") from None
    file = started.write("bench.json", figures)
    hint = f"; {messages.hint(folder, figures['weights'], 'shows')}" if path.run else ""
    print(f"\nresult: {file}{hint}")
    return 0


def _ddim_steps(args: BenchArgs, policy: config_lib.PolicyConfig) -> list[int]:
    """Returns the numbers of denoising steps to time.

    Raises:
      errors.UsageError: the policy has no such steps, or fewer.
    """
    expected = "a policy of the learner diffusion"
    argument = "RUN" if args.run else "--policy"
    checks.expect(policy.learner == "diffusion", argument, expected, f"one of {policy.learner}")
    limit = policy.options.diffusion_steps
    for count in args.ddim_steps:
        checks.expect(count <= limit, "--ddim-steps", f"1 to {limit}", count)
    return [*args.ddim_steps] or [count for count in DDIM_STEPS if count <= limit]


def _time(args: BenchArgs, path: policy_args.PolicyPath) -> dict[str, Any]:
    """Prints and returns the rows of Table IV."""
    from starjax.core import methods
    from starjax.evaluation import latency
    from starjax.policies import features

    who, _ = policy_args.load(path)
    trained = who.trained
    method = path.run.name if path.run else trained.method
    steps = _ddim_steps(args, trained.policy)
    sensors = features.select_sensors(who.env.task, trained.scene.cameras)
    print("  DDIM steps      p50      p95      p99 ms       Hz")
    figures = {}
    rows = latency.table(
        methods.METHODS[method],
        trained.policy,
        trained.params,
        trained.normalizer,
        sensors,
        ddim_steps=steps,
        calls=args.calls,
    )
    for row in rows:
        count = str(row["ddim_steps"])  # keys of JSON are strings
        figures[count] = row
        print(_row(count, row), flush=True)
    roll = None
    if methods.METHODS[method].hierarchical:
        roll = latency.roll_ms(trained.policy, sensors, calls=args.calls)
        print(_row("roll net", roll))
    return {
        "method": method,
        "weights": who.weights,
        "inference_ms_by_ddim_steps": figures,
        "roll_network_ms": roll,
    }


def _row(name: str, ms: dict[str, float]) -> str:
    times = " ".join(f"{ms[key]:8.3f}" for key in ("p50", "p95", "p99"))
    return f"  {name:10} {times}    {1e3 / ms['p50']:8.1f}"
