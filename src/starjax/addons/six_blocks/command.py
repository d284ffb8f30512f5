"""`starjax six-blocks`: scores six successive transfers with two arms, as surgeons are."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from starjax.cli import checks, messages, options, policy_args, session
from starjax.core import config as config_lib
from starjax.core import errors
from starjax.core.limits import Count

TASK = "peg_transfer_bimanual"

DESCRIPTION = """Scores the transfer of six blocks, each passed from tool to tool in the air.

RUN is the directory of a method trained for peg_transfer_bimanual. --policy takes a
policy.safetensors or the name of a packaged policy instead. With neither, the task's scripted
expert acts. A trial ends when a block is dropped, or after 300 s. Rerun the same command to
resume.

Examples:
  starjax six-blocks
  starjax six-blocks runs/gpu/stardiff --trials 5"""


@dataclasses.dataclass(frozen=True)
class SixBlocksArgs(policy_args.PolicyArgs):
    """Flags of the command."""

    trials: Count = 1  # trials for each of the twelve pairs of trocars
    seed: config_lib.Seed = 0  # random seed of the trials
    # directory of the result; auto: one in RUN or in runs/exercise
    out: str = options.AUTO


def main(argv: Sequence[str]) -> int:
    """Runs the missing trials; writes exercise.json."""
    args = options.parse("six-blocks", SixBlocksArgs, argv, DESCRIPTION)
    is_expert = not (args.run or args.policy)
    path = None if is_expert else policy_args.resolve(args)
    folder = _folder(path, args)
    started = session.start("six-blocks", argv, folder)

    from starjax.addons.six_blocks import figures as exercise

    with started.shared() as share:
        trials = folder / "trials"
        scored = _score_policy(trials, path, args) if path else _score_expert(trials, args)
        table, env, agent = scored
        figures = exercise.compose(table, env.control_hz)
        if share.is_first:
            content = {
                "scene": env.names._asdict(),
                **agent,
                "seed": args.seed,
                "trials_at_each_trocar": args.trials,
                **figures,
            }
            file = started.write("exercise.json", content)
            print(f"\n{_outcome(figures)}\nresult: {file}")
    return 0


def _folder(path: policy_args.PolicyPath | None, args: SixBlocksArgs) -> Path:
    """Returns the directory of the result."""
    trials = f"seed{args.seed}-{args.trials}"
    if path:
        return path.folder("exercise", [trials], args.out)
    default = Path("runs/exercise") / "-".join(["expert", *args.arm, trials])
    folder = default if args.out == options.AUTO else Path(args.out)
    checks.expect_folder("--out", args.out and folder)
    return folder


def _score_expert(folder: Path, args: SixBlocksArgs) -> tuple[Any, Any, dict[str, str]]:
    """Returns the trials of the scripted expert, their environment, and the expert's name."""
    from starjax.addons.six_blocks import environment as six_blocks
    from starjax.addons.six_blocks import task as six
    from starjax.evaluation import evaluate
    from starjax.sim.rollouts import agent

    env = six_blocks.make(args.arm, observation="state")
    name = next(iter(six.TASK.experts))
    table = evaluate.evaluate(
        folder,
        env,
        agent.from_single(six_blocks.reset_each_block(six.TASK.expert())),
        (),
        six.TASK.trocars,
        evaluate.EvaluationSettings(args.trials, args.seed, six.LIMIT_S),
        identity={"expert": name},
        report=messages.indented,
    )
    return table, env, {"expert": name}


def _score_policy(
    folder: Path, path: policy_args.PolicyPath, args: SixBlocksArgs
) -> tuple[Any, Any, dict[str, str]]:
    """Returns the trials of a policy, their environment, and the policy's method and weights."""
    from starjax.addons.six_blocks import environment as six_blocks
    from starjax.addons.six_blocks import task as six
    from starjax.cli import policy_evaluation
    from starjax.sim import env as sim_env

    who, _ = policy_args.load(path)
    names, trained = who.env.names, who.trained
    if names.task != TASK:
        raise errors.UsageError("RUN or --policy", f"a policy for {TASK}", f"one for {names.task}")
    env = six_blocks.wrap(sim_env.for_policy(names, trained.policy, variant=six.TASK))
    trials = config_lib.TrialsConfig(trials=args.trials, time_limit_s=six.LIMIT_S, video_trials=0)
    who = who._replace(env=env)
    table = policy_evaluation.rollouts(folder, who, six.TASK.trocars, trials, args.seed)
    return table, env, {"method": trained.method, "weights": who.weights}


def _outcome(figures: dict[str, Any]) -> str:
    """Returns two lines: moved blocks with times, and the times of people."""
    complete, seconds, people = figures["complete"], figures["seconds"], figures["people"]
    time = f"in {seconds['median']:.0f} s (median)" if seconds else "in no trial"
    return (
        f"  all {figures['blocks']} blocks one way in {complete['successes']} of "
        f"{complete['trials']} trials, {time}; {figures['moved']['mean']:.1f} blocks per trial, "
        f"{figures['dropped']} dropped\n"
        f"  people, both ways: proficient {people['proficient_s']:.0f} s, "
        f"residents {people['residents_s']:.0f} s"
    )
