"""The stages of a run, one after another, each skipped when its result is there."""

import functools
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from starjax import config as config_lib
from starjax import errors, methods
from starjax.commands import demonstrations, folders, messages, precompile, scenes, stage_times
from starjax.runtime import files, xla
from starjax.runtime.signals import stop_signals

STAGES = messages.STAGES
LEAST_FREE_BYTES = 64 << 20  # weights and figures; demonstrations and checkpoints ask for their own


def start() -> None:
    """Starts jax, in all processes of the run together."""
    xla.prepare_xla()
    from starjax.runtime import processes

    processes.join()
    xla.require_devices("starjax.sim.env", "starjax.training.loop")


def run(config: config_lib.RunConfig, stages: Sequence[str], command: str) -> None:
    """Does what is missing of the given stages, in the order of `STAGES`.

    Args:
      config: settings.
      stages: some of `STAGES`; one needs those before it.
      command: what was typed, for the record.
    """
    start()
    from starjax.rollouts import sharing
    from starjax.runtime import processes
    from starjax.training import devices

    config = scenes.resolved(config)
    if config.policy.freeze_encoder and not processes.is_alone():
        raise errors.UsageError("policy.freeze_encoder", "one process", "several")
    if "train" in stages:
        devices.make_mesh(config.train.batch_size)  # a mistake is found before demonstrations are
    out, names = Path(config.out), folders.selected(config)
    trained = list(dict.fromkeys(methods.METHODS[name].weights_of for name in names))
    untrained = [name for name in trained if not folders.weights(out, name).exists()]
    encoder = demonstrations.frozen_encoder(config) if "train" in stages and untrained else None
    files.require_writable(out, LEAST_FREE_BYTES)
    with sharing.shared(out) as share, messages.first_process_only(share.is_first):
        print(messages.plan(config, stages), flush=True)
        env = _environment(config)
        root, collect, compile_collect = demonstrations.plan(config, env, share)
        digest = folders.demos_digest(root) if config.demos.from_ else None
        dataset = f"{root.name}-{digest[:12]}" if digest else root.name

        def claim() -> None:
            for name in dict.fromkeys([*trained, *names]):
                folders.claim(out / name, config, dataset, encoder and encoder.fingerprint)

        new = next((name for name in names if methods.METHODS[name].weights_of in untrained), None)
        ready = precompile.Precompiled()
        if untrained or "train" not in stages:
            compile_collect()
        if new:
            ready = precompile.begin(config, new, stages, env, encoder)
        # Loaded once, and only if something is still to be trained with them.
        demos = functools.cache(lambda: demonstrations.load(config, root, collect, encoder, share))
        if "train" not in stages:
            collect()
        else:
            share.first("claimed", claim)
            for name in trained:
                step = ready.step if [name] == untrained[:1] else None
                _train(config, name, demos, env, encoder, share, step)
        if "evaluate" in stages:
            for name in names:
                policy = ready.policy if name == new else None
                _evaluate(config, name, env, root, command, share, policy)
        if "report" in stages:
            share.first("reported", lambda: _report(out, names))


def _environment(config: config_lib.RunConfig) -> Any:
    # Here and below, what brings jax is imported where it is used, after XLA has been prepared.
    from starjax.sim import env

    return env.for_policy(scenes.names(config.scene), config.policy)


def _train(
    config: config_lib.RunConfig,
    name: str,
    demos: Callable[[], Any],
    env: Any,
    encoder: Any,
    share: Any,
    step: Callable[[], Any] | None = None,
) -> None:
    """One set of weights; `policy.safetensors` is its last file."""
    from starjax.policies import policy_file
    from starjax.runtime import processes
    from starjax.training import loop

    out = Path(config.out)
    folder = out / name
    weights = folders.weights(out, name)
    if share.first(f"{name} was trained", weights.exists):
        messages.stage("train", f"{name}: done before, {weights}")
        return
    dataset = demos()
    messages.stage("train", f"{name}, into {folder}")
    program = step() if step else None
    begun = any((folder / "checkpoints").glob("step_*"))
    with stage_times.timed(out, f"train {name}", begun), stop_signals() as should_stop:
        result = loop.run(
            methods.METHODS[name],
            config.policy,
            config.train,
            dataset,
            env.task,
            folder,
            config.seed,
            cameras=env.names.cameras,
            should_stop=should_stop,
            description=f"Training {name}",
            step_program=program,
        )
    state = processes.own(result.state)
    params = state.ema_params
    made = policy_file.Trained(
        method=name,
        policy=config_lib.inference_settings(config.policy),
        train=config.train,
        params={**params, "vision": encoder.params} if encoder else params,
        normalizer=state.normalizer,
        scene=env.names,
        p_world_ref=tuple(map(tuple, env.p_world_ref)),
        roll_zero=tuple(slot.roll_zero for slot in env.task.slots),
        demos=config.demos,
        preset=config.preset,
    )
    share.first(f"{name} is saved", lambda: policy_file.save(weights, made))
    errors = ", ".join(f"{key} {value:.3g}" for key, value in result.holdout.items())
    messages.indented(f"{result.samples_per_second:.0f} samples/s; held-out {errors or 'none'}")
    # Asked during the last steps, whose loop looks no more. Several processes go on: the others
    # would wait for this one.
    if should_stop() and processes.is_alone():
        raise KeyboardInterrupt(
            f"stopped after training {name}; its weights are {weights}, the same command goes on "
            "from there"
        )


def _evaluate(
    config: config_lib.RunConfig,
    name: str,
    env: Any,
    demos: Path,
    command: str,
    share: Any,
    policy: Callable[[], Any] | None = None,
) -> None:
    """Closed-loop trials of one method; `result.json` is its last file."""
    from starjax.commands import policy_evaluation

    out = Path(config.out)
    folder, weights = out / name, folders.weights(out, name)
    if share.first(f"{name} was scored", lambda: _was_scored(config, folder, weights, env)):
        messages.stage("evaluate", f"{name}: done before, {folder / 'result.json'}")
        return
    messages.stage("evaluate", f"{name}, into {folder / 'evaluation'}")
    share.first(f"{name} has an equal evaluation", lambda: folders.adopt_equivalent(out, name))
    compiled = policy() if policy else None
    with stage_times.timed(out, f"evaluate {name}", folders.is_under_way(folder)):
        who = policy_evaluation.load(name, weights, env, policy=compiled)
        trials = folder / "evaluation"
        table = policy_evaluation.rollouts(trials, who, env.task.trocars, config.eval, config.seed)

    def write() -> None:
        timings = _timings(out, name, demos.name)
        digest = folders.demos_digest(demos)
        policy_evaluation.write_result(
            folder, who, table, config, config.seed, command, timings, digest
        )

    share.first(f"{name} is scored", write)


def _was_scored(config: config_lib.RunConfig, folder: Path, weights: Path, env: Any) -> bool:
    """Whether a method's result is there.

    Raises:
      errors.UsageError: fewer trials would replace it.
    """
    found = _scored(folder, files.sha256(weights))
    if found and _is_of(found, config):
        return True
    count = len(env.task.is_seen)
    if found and (more := len(found.trials)) > count * config.eval.trials:
        raise errors.UsageError(
            "eval.trials",
            f"no fewer than the {more // count} of {folder / 'result.json'}",
            config.eval.trials,
            f"starjax evaluate {shlex.quote(str(folder))} keeps them apart",
        )
    return False


def _scored(folder: Path, weights: str) -> Any:
    """The `result.Result` in result.json, None if it is missing, damaged or of other weights."""
    from starjax.evaluation import result

    try:
        found = result.read(folder / "result.json")
    except (FileNotFoundError, ValueError):  # damaged: made again
        return None
    # older results do not say whose they are
    return found if found.trials and found.weights in (None, weights) else None


def _is_of(found: Any, config: config_lib.RunConfig) -> bool:
    """Whether a result is of these settings."""
    try:
        before = config_lib.from_dict(config_lib.RunConfig, found.config)
    except (AttributeError, KeyError, TypeError, ValueError):
        return False
    alike = config_lib.weight_settings(before) == config_lib.weight_settings(config)
    return alike and before.eval == config.eval and found.seed in (None, config.seed)


def _timings(out: Path, name: str, demos: str) -> dict[str, float]:
    """Seconds of the stages that a method's result rests on, compilation apart.

    `demos` is the folder of its demonstrations.
    """
    stages = {
        "collect": f"collect {demos}",
        "features": "features",
        "train": f"train {methods.METHODS[name].weights_of}",
        "evaluate": f"evaluate {name}",
    }
    spent = stage_times.read(out)
    return {
        f"{stage}{part}": spent[f"{key}{part}"]
        for stage, key in stages.items()
        for part in ("", ": compile")
        if f"{key}{part}" in spent
    }


def _report(out: Path, names: Sequence[str]) -> None:
    """The report of every method in the folder, and the outcome of this run's."""
    from starjax.evaluation import result
    from starjax.report import build

    scored = [out / name for name in methods.METHODS if (out / name / "result.json").exists()]
    messages.stage("report", f"of {', '.join(path.name for path in scored)}, into {out / 'report'}")
    with stage_times.timed(out, "report"):
        try:
            page = build.build(scored, out / "report", report=messages.indented)
        except ValueError as error:  # of a damaged file, which it names
            raise errors.UsageError(str(out), "results that are whole", error) from error
    results = [result.read(out / name / "result.json") for name in names]
    print(f"\n{messages.outcome(results)}\n\nreport: {page}", flush=True)
