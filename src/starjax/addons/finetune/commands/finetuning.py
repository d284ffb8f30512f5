"""Rounds of a fine-tuning in their order, and its outcome."""

import os
from pathlib import Path
from typing import Any

import jax
import numpy as np

import starjax
from starjax.addons.finetune.commands import finetune_distill, finetune_rl, finetune_stages
from starjax.addons.finetune.commands import finetune_work as works
from starjax.addons.finetune.commands.finetune_work import Work
from starjax.addons.finetune.settings import FinetuneConfig
from starjax.cli import messages, policy_args, policy_evaluation, session, stage_times
from starjax.core import errors, extras, methods
from starjax.evaluation import statistics
from starjax.policies.in_env import PolicyInEnv
from starjax.runtime import files, precompile, processes
from starjax.sim.rollouts.sharing import Share

_PEAK = "peak_bytes_in_use"  # for a device's statistics, which a CPU does not have
_WAYS = {
    "dagger": finetune_stages.Imitation,
    "rl": finetune_rl.PolicyGradient,
    "distill": finetune_distill.Distillation,
}


def run(
    settings: FinetuneConfig, path: policy_args.PolicyPath, started: session.Session, share: Share
) -> None:
    """Completes a fine-tuning.

    Raises:
      errors.UsageError: several processes, a directory of other settings, or a setting that does
        not suit the policy.
    """
    if not processes.is_alone():
        raise errors.UsageError("starjax finetune", "one process", "several")
    work = works.begin(settings, path, started, share)
    print(_plan(work), flush=True)
    with precompile.until_end():
        print("\n[round 0] validation of the policy itself", flush=True)
        table = finetune_stages.validate(work, 0, work.base)
        improve = _WAYS[settings.by](work, table.steps[table.success]).round
        described = [{"round": 0, "validation": statistics.rate(table.success)}]
        candidates, who = [path.file], work.base
        reports: dict[int, dict[str, Any]] = {}
        for number in range(1, settings.rounds + 1):
            if work.is_late() and not work.is_trained(number):
                messages.indented("time is up: no further round")
                break
            made = improve(number, who, candidates[-1])
            if made is None:
                break
            file, counts = made
            candidates.append(file)
            who = work.place(candidates[-1])
            rate = statistics.rate(finetune_stages.validate(work, number, who).success)
            described.append({"round": number, **counts, "validation": rate})
            messages.indented(f"validation {messages.rate(rate)}")
            if number < settings.rounds and not work.is_trained(number + 1):
                _keep(work, candidates, described, reports)
        content = _keep(work, candidates, described, reports)
    if not extras.missing("report", "video"):
        from starjax.addons.finetune.commands import finetune_page

        print(f"report: {finetune_page.write(work.out, content)}", flush=True)


def _plan(work: Work) -> str:
    """Returns the plan of a fine-tuning, for its start."""
    settings, config = work.settings, work.config
    trocars = len(work.seen.radius)
    label = methods.SCORED[work.stored.method].label
    name = os.path.relpath(work.file)
    rate = f"rate {config.train.learning_rate:.2g}"
    steps = f"{config.train.steps} steps of {config.train.batch_size} per round, {rate}"
    rollouts = f"{trocars} seen trocars x {settings.trials} trials"
    work_of_round = {
        "dagger": (rollouts, f"{steps}, demonstrations and rollouts by an even coin"),
        "rl": (
            f"{settings.iterations} iterations of {settings.episodes} episodes",
            f"in every iteration, rate {settings.gradient_rate:.2g}",
        ),
        "distill": (
            f"{settings.episodes} episodes",
            f"{steps}, demonstrations, and as many states of the episodes",
        ),
    }
    played, trained = work_of_round[settings.by]
    return "\n".join(
        [
            f"starjax {starjax.__version__}: {label} of {name}, fine-tuned by {settings.by}, "
            f"seed {settings.seed}, folder {work.out}",
            f"  rounds          {settings.rounds}, each of {played}",
            f"  training        {trained}",
            f"  validation      {trocars} seen trocars x {settings.validation} trials",
            f"  report          {len(work.base.env.task.is_seen)} trocars x {settings.eval.trials} "
            "trials, before and after",
        ]
    )


def _keep(
    work: Work,
    candidates: list[Path],
    described: list[dict[str, Any]],
    reports: dict[int, dict[str, Any]],
) -> dict[str, Any]:
    """Keeps the best round so far; scores it and the policy itself; returns their figures.

    Every round ends with it: a fine-tuning that is stopped later has an outcome. `reports` has the
    figures by round, and gets the new ones.
    """
    best = int(np.argmax([one["validation"]["successes"] for one in described]))
    files.write_bytes(work.out / "policy.safetensors", candidates[best].read_bytes())
    for name, number in {"before": 0, **({"after": best} if best else {})}.items():
        if number not in reports:
            who = work.place(candidates[number]) if number else work.base
            reports[number] = _score(work, name, who)
    rows = {"before": reports[0], **({"after": reports[best]} if best else {})}
    content = {
        "by": work.settings.by,
        "task": work.base.env.task.name,
        "method": work.stored.method,
        "seed": work.settings.seed,
        "weights": work.base.weights,
        "rounds": described,
        "best": best,
        **rows,
        "timings_s": stage_times.read(work.out),
        "peak_device_bytes": (jax.local_devices()[0].memory_stats() or {}).get(_PEAK),
    }
    path = work.started.write("finetune.json", content)
    print(f"\n  {'success [95% interval]':24}{'seen':26}unseen")
    for name, row in rows.items():
        print(f"  {name:24}{messages.rate(row['seen']):26}{messages.rate(row['unseen'])}")
    kept = f"round {best}" if best else "the policy itself: no round is better in validation"
    print(f"\npolicy: {work.out / 'policy.safetensors'}, {kept}; figures: {path}", flush=True)
    return content


def _score(work: Work, name: str, who: PolicyInEnv) -> dict[str, Any]:
    """Returns the success of a policy at seen and unseen trocars, and its RCM error."""
    print(f"\n[report] {name}", flush=True)
    folder, settings = work.out / name, work.settings
    with stage_times.timed(work.out, name):
        table = policy_evaluation.rollouts(
            folder / "evaluation", who, who.env.task.trocars, settings.eval, settings.seed
        )
    figures = policy_evaluation.write_result(
        folder, who, table, work.config, settings.seed, work.started.command
    ).figures
    return {part: figures[part] for part in ("seen", "unseen", "rcm_error_mm")}
