"""`starjax six-blocks`: six blocks one after another with two arms, as surgeons are scored."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from starjax import config as config_lib
from starjax import errors
from starjax.commands import checks, messages, options, policy_args
from starjax.limits import Count
from starjax.runtime import files, xla

TASK = "peg_transfer_bimanual"

DESCRIPTION = """Scores six blocks, one after another, each passed from tool to tool in the air.

RUN is the folder of a method that was trained for peg_transfer_bimanual; or --policy names a
policy.safetensors. With neither the task's scripted expert acts. A trial ends when a block is
dropped, or after 300 s. The same command again goes on from the trials that are done."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Flags of the command."""

    run: options.RunOrNone = ""  # a method's folder, such as runs/cpu/stardiff
    policy: str = ""  # a policy.safetensors instead of RUN
    arm: tuple[str, ...] = ()  # robots to score it with; left out: those it was trained with
    trials: Count = 1  # at each of the twelve pairs of trocars
    seed: config_lib.Seed = 0  # of the trials
    # folder of the result; auto: one in RUN or in runs/exercise
    out: str = options.AUTO


def main(argv: Sequence[str]) -> int:
    """Runs the trials that are missing; writes exercise.json."""
    chosen = options.parse(Options, argv, prog="starjax six-blocks", description=DESCRIPTION)
    is_expert = not (chosen.run or chosen.policy)
    named = None if is_expert else policy_args.resolve(chosen.run, chosen.policy)
    folder = _folder(named, chosen)
    xla.prepare_xla()
    xla.require_devices("starjax.commands.policy_evaluation")
    files.require_writable(folder)

    from starjax.evaluation import exercise

    table, env, about = _score(folder / "trials", named, chosen)
    figures = exercise.compose(table, env.control_hz)
    files.write_json(folder / "exercise.json", _content(env, chosen, argv, figures, about))
    print(f"\n{_outcome(figures)}\nresult: {folder / 'exercise.json'}")
    return 0


def _folder(named: policy_args.PolicyPath | None, chosen: Options) -> Path:
    name = "-".join([*chosen.arm, f"seed{chosen.seed}-{chosen.trials}"])
    if named is None:
        default = Path("runs/exercise") / f"expert-{name}"
    elif named.run:
        default = named.run / f"exercise-{name}"
    else:
        default = Path("runs/exercise") / f"{policy_args.label(named.file)}-{name}"
    folder = default if chosen.out == options.AUTO else chosen.out
    checks.expect_folder("--out", folder)
    return Path(folder)


def _score(
    folder: Path, named: policy_args.PolicyPath | None, chosen: Options
) -> tuple[Any, Any, dict]:
    """The trials' table, the environment, and who acted."""
    from starjax.commands import policy_evaluation
    from starjax.evaluation import evaluate
    from starjax.rollouts import agent
    from starjax.sim import env as sim_env
    from starjax.sim import six_blocks
    from starjax.sim.tasks.peg_transfer_bimanual.six import LIMIT_S
    from starjax.sim.tasks.peg_transfer_bimanual.six import TASK as task

    if named is None:
        env = six_blocks.make(chosen.arm, observation="state")
        name = next(iter(task.experts))
        table = evaluate.evaluate(
            folder,
            env,
            agent.from_single(six_blocks.reset_each_block(task.expert())),
            (),
            task.trocars,
            evaluate.Settings(chosen.trials, chosen.seed, LIMIT_S),
            identity={"expert": name},
            report=messages.indented,
        )
        return table, env, {"expert": name}
    who, _ = policy_args.load(named, chosen.arm)
    names = who.env.names
    if names.task != TASK:
        raise errors.UsageError("RUN or --policy", f"one trained for {TASK}", f"of {names.task}")
    env = six_blocks.wrap(sim_env.for_policy(names, who.trained.policy, variant=task))
    trials = config_lib.EvalConfig(trials=chosen.trials, time_limit_s=LIMIT_S, video_trials=0)
    subject = who._replace(env=env)
    table = policy_evaluation.rollouts(folder, subject, task.trocars, trials, chosen.seed)
    return table, env, {"method": who.trained.method, "weights": who.weights}


def _outcome(figures: dict[str, Any]) -> str:
    """Two lines: what was done, and in what time."""
    complete, seconds, people = figures["complete"], figures["seconds"], figures["people"]
    time = f"in {seconds['median']:.0f} s (median)" if seconds else "in no trial"
    return (
        f"  all {figures['blocks']} blocks one way in {complete['successes']} of "
        f"{complete['trials']} trials, {time}; {figures['moved']['mean']:.1f} blocks a trial, "
        f"{figures['dropped']} dropped\n"
        f"  people, both ways: proficient {people['proficient_s']:.0f} s, "
        f"residents {people['residents_s']:.0f} s"
    )


def _content(
    env: Any, chosen: Options, argv: Sequence[str], figures: dict[str, Any], about: dict[str, Any]
) -> dict[str, Any]:
    from starjax.runtime import jax_settings, provenance

    return {
        "scene": env.names._asdict(),
        **about,
        "seed": chosen.seed,
        "trials_at_each_trocar": chosen.trials,
        "command": options.typed("six-blocks", argv),
        **figures,
        **provenance.code()._asdict(),
        "versions": xla.versions(),
        "hardware": xla.hardware(),
        **jax_settings.record(),
    }
