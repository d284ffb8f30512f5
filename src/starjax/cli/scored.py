"""Results of a run's earlier evaluations."""

import dataclasses
import shlex
from pathlib import Path
from typing import Any

from starjax.core import config as config_lib
from starjax.core import config_json, errors, sources
from starjax.evaluation import result
from starjax.runtime import files
from starjax.sim.state import Env


def is_complete(config: config_lib.RunConfig, folder: Path, weights: Path, env: Env) -> bool:
    """Returns True if the result of a method is complete.

    Raises:
      errors.UsageError: fewer trials would replace it, or a part's code is another under an equal
        version.
    """
    scored = _read(folder, files.sha256(weights))
    now = sources.record(result.parts_of(env.names, config_json.as_json(config)))
    is_current = scored and scored.about.get("parts", now["parts"]) == now["parts"]
    if is_current and _is_of(scored, config):
        sources.refuse_other_code(folder / "result.json", scored.about, now)
        return True
    count = len(env.task.is_seen)
    if scored and (more := len(scored.trials)) > count * config.eval.trials:
        raise errors.UsageError(
            "eval.trials",
            f"no fewer than the {more // count} of {folder / 'result.json'}",
            config.eval.trials,
            f"starjax evaluate {shlex.quote(str(folder))} keeps them apart",
        )
    return False


def _read(folder: Path, weights: str) -> Any:
    """Returns the result of these weights, None if it is missing or damaged."""
    try:
        scored = result.read(folder / "result.json")
    except (FileNotFoundError, ValueError):  # damaged: made again
        return None
    return scored if scored.trials and scored.weights == weights else None


def _is_of(scored: result.Result, config: config_lib.RunConfig) -> bool:
    """Returns True if a result has these settings."""
    try:
        before = config_json.from_dict(config_lib.RunConfig, scored.config)
    except (AttributeError, KeyError, TypeError, ValueError):
        return False
    alike = config_json.weight_settings(before) == config_json.weight_settings(config)
    now = dataclasses.replace(config.eval, seed=before.eval.seed)
    return alike and before.eval == now and scored.seed == config.trial_seed
