"""Stages of a run in their order; complete ones are skipped."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from starjax.cli import (
    demonstrations,
    folders,
    messages,
    plan_text,
    policy_evaluation,
    precompile,
    scenes,
    scored,
    session,
    stage_times,
)
from starjax.core import config as config_lib
from starjax.core import config_json, errors, learners, methods, sources
from starjax.evaluation import result as results
from starjax.policies import in_env, policy_file
from starjax.runtime import files, processes
from starjax.runtime import precompile as background
from starjax.runtime.signals import stop_signals
from starjax.sim import env as envs
from starjax.sim import registries
from starjax.sim.rollouts import sharing
from starjax.sim.state import Env
from starjax.training import devices, loop, randomise, trackers
from starjax.training.encoder import Encoder

STAGES = messages.STAGES
MIN_FREE_BYTES = 64 << 20  # weights and figures; demonstrations and checkpoints check their own


@dataclasses.dataclass(frozen=True)
class RunContext:
    """A run at work: the argument of its stages.

    Attributes:
      config: settings with the scene named in full.
      encoder: frozen image encoder, or None.
      share: this process's part in the run's directory.
      command: command line, for results.
      tracker: name of a tracker, see `training.trackers`.
    """

    config: config_lib.RunConfig
    encoder: Encoder | None
    share: sharing.Share
    command: str
    tracker: str = ""

    @property
    def out(self) -> Path:
        """Directory of the run."""
        return Path(self.config.out)

    @functools.cached_property
    def env(self) -> Any:
        """Environment with the observation of the training, built on first use."""
        return _environment(self.config)


def run(
    config: config_lib.RunConfig, stages: Sequence[str], command: str, tracker: str = ""
) -> None:
    """Completes the given stages in the order of `STAGES`.

    Args:
      config: settings.
      stages: some of `STAGES`; each needs those before it.
      command: command line, for results.
      tracker: see `RunContext`.
    """
    config = scenes.resolved(config)
    _check(config.policy, config.train, stages)
    names = methods.selected(config.method)
    if "train" in stages:
        scenes.check_wrists(config.scene, names)
    out, trains = Path(config.out), "train" in stages
    trained = list(dict.fromkeys(methods.METHODS[name].weights_of for name in names))
    untrained = [name for name in trained if not folders.weights(out, name).exists()]
    encoder = demonstrations.frozen_encoder(config.policy) if trains and untrained else None
    files.require_writable(out, MIN_FREE_BYTES)
    with (
        background.until_end(),
        session.Session(command, out).shared(config_json.as_json(config)) as share,
    ):
        print(plan_text.plan(config, stages), flush=True)
        work = RunContext(config, encoder, share, command, tracker)
        root, collect, compile_collect = demonstrations.plan(config, work.env, share)
        if untrained or not trains:
            compile_collect()
        new = next((name for name in names if methods.METHODS[name].weights_of in untrained), None)
        programs = precompile.Precompiled()
        if new:
            programs = precompile.begin(work.config, new, stages, work.env, encoder)
        if not trains:
            collect()
        else:
            share.first("claimed", lambda: _claim(work, [*trained, *names], root))
            # Loaded once, and only if weights are missing.
            dataset = functools.cache(
                lambda: demonstrations.load(config, work.env, root, collect, encoder, share)
            )
            for name in trained:
                _train(work, name, dataset, programs.step if [name] == untrained[:1] else None)
        if "evaluate" in stages:
            for name in names:
                _evaluate(work, name, root, programs.policy if name == new else None)
        if "report" in stages:
            share.first("reported", lambda: _report(out, names))


def _check(
    policy: config_lib.PolicyConfig, train: config_lib.TrainConfig, stages: Sequence[str]
) -> None:
    """Raises UsageError for settings that the devices rule out, before demonstrations begin."""
    randomise.max_levels(train, policy)
    if policy.freeze_encoder and not processes.is_alone():
        raise errors.UsageError("policy.freeze_encoder", "one process", "several")
    if "train" in stages:
        devices.make_mesh(train.batch_size)


def draw_images(config: config_lib.RunConfig, env: Env) -> Any:
    """Returns the function that draws images anew in training, or None."""
    names = list(randomise.max_levels(config.train))
    moves = randomise.redraws(config.train)
    return scenes.disturbable(env, names, config.policy).draw if moves else None


def _environment(config: config_lib.RunConfig) -> Any:
    return envs.for_policy(scenes.names(config.scene), config.policy)


def _claim(work: RunContext, names: Sequence[str], demos: Path) -> None:
    """Records the settings in the directory of each method."""
    digest = folders.demos_digest(demos) if work.config.demos.from_ else None
    dataset = f"{demos.name}-{digest[:12]}" if digest else demos.name
    fingerprint = work.encoder and work.encoder.fingerprint
    for name in dict.fromkeys(names):
        folders.claim(work.out / name, _of_method(work, name), dataset, fingerprint)


def _of_method(work: RunContext, name: str) -> config_lib.RunConfig:
    """Returns the settings of one of the run's methods."""
    return dataclasses.replace(work.config, method=name)


def _train(
    work: RunContext,
    name: str,
    demos: Callable[[], Any],
    step: Callable[[], Any] | None = None,
) -> None:
    """Trains one set of weights; `policy.safetensors` is its last file."""
    config, env, share = work.config, work.env, work.share
    folder, weights = work.out / name, folders.weights(work.out, name)
    if share.first(f"{name} was trained", weights.exists):
        messages.stage("train", f"{name}: already complete, {weights}")
        return
    dataset = demos()
    messages.stage("train", f"{name}, into {folder}")
    program = step() if step else None
    begun = any((folder / "checkpoints").glob("step_*"))
    with (
        stage_times.timed(work.out, f"train {name}", begun),
        trackers.following(work.tracker, folder, config_json.as_json(config)),
        stop_signals() as should_stop,
    ):
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
            draw_images=draw_images(config, env),
        )
    state = processes.own(result.state)
    params = state.ema_params
    trained = policy_file.Trained(
        method=name,
        policy=config_lib.inference_settings(config.policy),
        train=config.train,
        params={**params, "vision": work.encoder.params} if work.encoder else params,
        normalizer=state.normalizer,
        scene=env.names,
        p_world_ref=tuple(map(tuple, env.p_world_ref)),
        roll_zero=tuple(slot.roll_zero for slot in env.task.slots),
        demos=config.demos,
        preset=config.preset,
        packages=sources.packages(
            [
                *registries.parts(env.names),
                *learners.parts(
                    *(name, config.policy.learner, config.policy.encoder),
                    config.policy.depth_encoder,
                ),
            ]
        ),
    )
    share.first(f"{name} is saved", lambda: policy_file.save(weights, trained))
    errors = ", ".join(f"{key} {value:.3g}" for key, value in result.holdout.items())
    messages.indented(f"{result.samples_per_second:.0f} samples/s; held-out {errors or 'none'}")
    # A stop during the last steps, after the loop's last look. Several processes continue: the
    # others would wait for this one.
    if should_stop() and processes.is_alone():
        raise KeyboardInterrupt(
            f"stopped after training {name}; its weights are {weights}, rerun the same command to "
            "resume"
        )


def _evaluate(
    work: RunContext, name: str, demos: Path, policy: Callable[[], Any] | None = None
) -> None:
    """Runs the closed-loop trials of one method; `result.json` is its last file."""
    config, env, share = _of_method(work, name), work.env, work.share
    folder, weights = work.out / name, folders.weights(work.out, name)
    if share.first(f"{name} was scored", lambda: scored.is_complete(config, folder, weights, env)):
        messages.stage("evaluate", f"{name}: already complete, {folder / 'result.json'}")
        return
    messages.stage("evaluate", f"{name}, into {folder / 'evaluation'}")
    share.first(f"{name} has an equal evaluation", lambda: folders.adopt_equivalent(work.out, name))
    compiled = policy() if policy else None
    with stage_times.timed(work.out, f"evaluate {name}", folders.is_under_way(folder)):
        trained = policy_evaluation.read(weights)
        who = in_env.place(weights, trained, env, method=name, policy=compiled)
        trials = folder / "evaluation"
        table = policy_evaluation.rollouts(
            trials, who, env.task.trocars, config.eval, config.trial_seed
        )

    def write() -> None:
        policy_evaluation.write_result(
            folder,
            who,
            table,
            config,
            config.trial_seed,
            work.command,
            timings_s=_timings(work.out, name, demos.name),
            dataset_digest=folders.demos_digest(demos),
        )

    share.first(f"{name} is scored", write)


def _timings(out: Path, name: str, demos: str) -> dict[str, float]:
    """Returns the seconds of the stages behind a method's result, and of their compilations.

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
    """Writes the report of all methods in the directory; prints the outcome of this run."""
    from starjax.report import build

    scored = [out / name for name in methods.METHODS if (out / name / "result.json").exists()]
    messages.stage("report", f"of {', '.join(path.name for path in scored)}, into {out / 'report'}")
    with stage_times.timed(out, "report"):
        try:
            page = build.build(scored, out / "report", report=messages.indented)
        except ValueError as error:  # from a damaged file, which it names
            raise errors.UsageError(str(out), "complete results", error) from error
    read = [results.read(out / name / "result.json") for name in names]
    print(f"\n{messages.outcome(read)}\n\nreport: {page}", flush=True)
