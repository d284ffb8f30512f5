"""The functions that `starjax` hands out: an environment, a policy, its training and its score."""

import dataclasses
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from starjax.cli import folders, pipeline, session
from starjax.core import errors
from starjax.core.config import RunConfig
from starjax.evaluation import evaluate as evaluation
from starjax.evaluation import statistics
from starjax.policies import in_env, packaged
from starjax.policies.in_env import PolicyInEnv
from starjax.sim.state import Env


def load_policy(policy: str | Path, env: Env | None = None) -> PolicyInEnv:
    """Loads a trained policy into an environment.

    Examples:
      >>> starjax.load_policy("runs/cpu/stardiff/policy.safetensors")

    Args:
      policy: a policy.safetensors, or a name of `starjax list`.
      env: an environment with the task and the observation of the training; by default its own.

    Raises:
      errors.UsageError: no such policy, or an environment of another task or observation.
    """
    file = packaged.find("policy", str(policy))
    trained = in_env.read(file, "policy")
    if env is None:
        return in_env.place_in_own_scene(file, trained)
    if (env.names.task, env.names.cameras) != (trained.scene.task, trained.scene.cameras):
        expected = f"{trained.scene.task} through {', '.join(trained.scene.cameras)}"
        raise errors.UsageError("env", expected, f"{env.names.task}, {env.names.cameras}")
    return in_env.place(file, trained, env)


def train(settings: RunConfig, folder: str | Path) -> Path:
    """Records the expert's demonstrations and trains a policy on them, as `starjax train` does.

    Examples:
      >>> starjax.train(starjax.PRESETS["smoke"], "runs/mine")
      PosixPath('runs/mine/stardiff/policy.safetensors')

    Called again with the same arguments it resumes, or returns at once.

    Args:
      settings: a preset, or one that `dataclasses.replace` changed.
      folder: gets the demonstrations, checkpoints and the policy.

    Returns:
      the policy's file.
    """
    settings = dataclasses.replace(settings, out=str(folder))
    session.start_run(settings)
    pipeline.run(settings, ("collect", "train"), "starjax.train")
    return folders.weights(Path(folder), settings.method)


def evaluate(
    policy: PolicyInEnv, trials: int = 4, seed: int = 0, time_limit_s: float = 30.0
) -> dict[str, Any]:
    """Scores a policy in closed loop at all trocars of its task, as one program.

    Examples:
      >>> figures = starjax.evaluate(policy, trials=1)
      >>> figures["unseen"]

    Args:
      policy: from `load_policy`.
      trials: at each trocar.
      seed: of the starts; policies with the same seed meet the same trials.
      time_limit_s: simulated seconds of a trial.

    Returns:
      figures of a result.json: `seen`, `unseen`, `rcm_error_mm`, `steps`, `per_trocar` and more.
    """
    trained, task = policy.trained, policy.env.task
    with tempfile.TemporaryDirectory() as folder:
        table = evaluation.evaluate(
            Path(folder),
            policy.env,
            policy.agent(),
            (trained.params, trained.normalizer),
            task.trocars,
            evaluation.EvaluationSettings(trials, seed, time_limit_s),
            report=lambda line: None,
        )
    count = trained.demos.seen_trocars if trained.demos else len(task.is_seen)
    is_seen = task.is_seen & (np.arange(len(task.is_seen)) < count)
    observation = trained.policy.observation
    return statistics.compose(
        table, is_seen, method=trained.method, observation=observation, seed=seed
    )
