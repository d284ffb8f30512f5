"""A trained policy in closed loop: rollouts of a method, and the result.json that they become."""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from starjax import rcm
from starjax.cli import messages, plan_text
from starjax.core import config as config_lib
from starjax.core import config_json, errors, methods
from starjax.data import normalizer
from starjax.evaluation import alarms, evaluate, latency, statistics
from starjax.evaluation import result as results
from starjax.evaluation import trials as table
from starjax.policies import features, in_env, policy_file
from starjax.policies import policy as policies
from starjax.policies.in_env import PolicyInEnv
from starjax.policies.monitor.record import Monitor
from starjax.policies.monitor.scores import ScoreSettings
from starjax.runtime.precompile import Program
from starjax.sim.rollouts import placement
from starjax.sim.state import Env


def load(method: str, weights: Path, arms: Sequence[str] = ()) -> PolicyInEnv:
    """Loads a method's weights from the directory of its run, and builds their environment.

    Args:
      method: a row of `methods.METHODS`.
      weights: policy.safetensors.
      arms: robots instead of those of the training.

    Raises:
      errors.UsageError: the file is missing or damaged.
    """
    return in_env.place_in_own_scene(weights, read(weights), method=method, arms=arms)


def read(weights: Path) -> policy_file.Trained:
    """Reads weights in the directory of a run.

    Raises:
      errors.UsageError: the file is missing or damaged.
    """
    again = f"starjax run with its flags and --out {shlex.quote(str(weights.parent.parent))}"
    if not weights.exists():
        raise errors.UsageError(str(weights), "trained weights", "none", f"{again} trains them")
    return in_env.read(weights, str(weights), f"remove it, and {again} trains it again")


def rollouts(
    directory: Path,
    who: PolicyInEnv,
    trocars: rcm.Trocar,
    settings: config_lib.TrialsConfig,
    seed: int,
    levels: Mapping[str, float] | None = None,
    score_settings: ScoreSettings | None = None,
) -> table.Table:
    """Runs the missing trials of an evaluation.

    Args:
      directory: of this evaluation alone.
      who: the policy in its environment.
      trocars: fields `[C, A]`.
      settings: number of trials, time limit and so on.
      seed: of the trials.
      levels: of the environment's disturbances.
      score_settings: of the table's scores; by default those of the policy's monitor, if any.
    """
    trained = who.trained
    if score_settings is None and (monitor := monitor_of(who, settings)):
        score_settings = monitor.settings
    with who.faults():
        return evaluate.evaluate(
            directory,
            who.env,
            who.agent(settings.ensemble),
            (trained.params, trained.normalizer),
            trocars,
            _settings(settings, seed),
            layout=placement.DeviceLayout(devices=placement.devices()),
            identity={
                **methods.behaviour(trained.method)._asdict(),
                "policy": config_json.as_json(trained.policy),
                **({"served": who.weights} if who.server else {}),
            },
            levels=levels,
            score_settings=score_settings,
            report=messages.indented,
        )


def monitor_of(who: PolicyInEnv, settings: config_lib.TrialsConfig) -> Monitor | None:
    """Returns the policy's monitor, None if its plans are averaged: it compares single plans."""
    return None if settings.ensemble else who.trained.monitor


def precompile(
    name: str, config: config_lib.RunConfig, env: Env, vision: policies.Params | None
) -> policies.Policy:
    """Compiles the programs of `rollouts` and `write_result` for a method without weights yet.

    Args:
      name: the method.
      config: settings of the run.
      env: environment with the observation of the training.
      vision: parameters of the frozen encoder, or None.

    Returns:
      the policy, for `load`: programs belong to its functions.
    """
    row, deciding = methods.METHODS[name], config_lib.inference_settings(config.policy)
    policy = policies.make(row, deciding, env.task, cameras=env.names.cameras)
    params = Program(policy.init).shapes(jax.random.key(0))
    if vision is not None:
        params = {**params, "vision": vision}
    params = jax.eval_shape(policy.prepare_for_inference, params)
    ablated = policies.ablated(row, config.policy)
    stats = normalizer.shapes(ablated, env.task, config.policy.observation == "state")
    evaluate.precompile(
        env,
        in_env.batch_agent(
            name, policy, deciding, config.eval.ensemble, normalizer.wrist_of(row, env.task)
        ),
        (params, stats),
        env.task.trocars,
        _settings(config.eval, config.trial_seed),
    )
    seen = features.select_sensors(env.task, env.names.cameras)
    latency.precompile(policy, deciding, params, stats, seen)
    return policy


def _settings(settings: config_lib.TrialsConfig, seed: int) -> evaluate.EvaluationSettings:
    return evaluate.EvaluationSettings(
        trials=settings.trials,
        seed=seed,
        time_limit_s=settings.time_limit_s,
        video_trials=settings.video_trials,
        chunk=settings.chunk,
    )


def inference_ms(who: PolicyInEnv) -> dict[str, float]:
    """Measures the time of one inference at batch size 1, from observation to commands."""
    trained = who.trained
    return latency.policy_ms(
        who.policy,
        trained.policy,
        trained.params,
        trained.normalizer,
        features.select_sensors(who.env.task, trained.scene.cameras),
        seconds=5.0,
    )


def write_result(
    folder: Path,
    who: PolicyInEnv,
    trials: table.Table,
    config: config_lib.RunConfig,
    seed: int,
    command: str,
    timings_s: dict[str, float] | None = None,
    dataset_digest: str | None = None,
) -> results.Result:
    """Writes `<folder>/result.json`: figures of `statistics.compose` and their origin.

    Args:
      folder: of the result.
      who: was evaluated.
      trials: of the task's trocars.
      config: settings of the run and of this evaluation.
      seed: of the trials; the run's own is in `config`.
      command: command line.
      timings_s: seconds by stage.
      dataset_digest: digest of the demonstrations, if available.
    """
    task = who.env.task
    is_seen = task.is_seen & (np.arange(len(task.is_seen)) < config.demos.seen_trocars)
    observation = who.trained.policy.observation
    figures = statistics.compose(
        trials, is_seen, method=who.trained.method, observation=observation, seed=seed
    )
    about: dict[str, Any] = {
        "control_hz": who.env.control_hz,
        "inference_ms": inference_ms(who),
        "preset": config.preset,
        "seed": seed,
        "weights": who.weights,
        "dataset_digest": dataset_digest,
        "config": config_json.as_json(config),
        "command": command,
        "timings_s": timings_s or {},
        "warnings": plan_text.warnings(config, figures),
    }
    if monitor := monitor_of(who, config.eval):
        about["alarms"] = alarms.compose(trials, monitor)
    if who.server:
        warnings = plan_text.served_warnings(who.server, figures)
        about |= {"server": who.server.origin, "warnings": warnings}
    return results.write(folder / "result.json", who.env.names, figures, about)
