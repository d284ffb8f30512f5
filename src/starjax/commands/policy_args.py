"""Which trained policy a command means: that of a method's folder, or a file of weights."""

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

from starjax import config as config_lib
from starjax import errors
from starjax.commands import folders, scenes
from starjax.policies import packaged
from starjax.runtime import files


class PolicyPath(NamedTuple):
    """Files of the policy that a command line names.

    Attributes:
      file: of the weights.
      run: the method's folder, None where the file itself was named.
    """

    file: Path
    run: Path | None


def resolve(run: str, policy: str) -> PolicyPath:
    """Finds what one of the two names.

    Args:
      run: a method's folder, or empty.
      policy: a file of weights or the name of a packaged policy, or empty.

    Raises:
      errors.UsageError: both are given or none, or there is no such thing.
    """
    if bool(run) == bool(policy):
        got = "both" if run else "none"
        raise errors.UsageError("RUN or --policy", "one of the two", got)
    if policy:
        return PolicyPath(packaged.find("--policy", policy), None)
    folder = folders.existing(run)
    folders.read_config(folder)
    return PolicyPath(folders.weights(folder.parent, folder.name), folder)


def label(file: Path) -> str:
    """A name for a file of weights: its own, or its folder's where that says nothing, and what is
    in it, as files of other weights are called so too."""
    if file.parent == packaged.FOLDER:
        return file.stem
    name = file.stem if file.stem != "policy" else file.resolve().parent.name
    return f"{name}-{files.sha256(file)[:8]}"


def load(named: PolicyPath, arms: tuple[str, ...]) -> tuple[Any, config_lib.RunConfig]:
    """Loads it, in its scene.

    Args:
      named: what.
      arms: robots instead of those that it was trained with.

    Returns:
      `in_env.PolicyInEnv`, and the known settings of the run that it comes from.
    """
    from starjax.commands import policy_evaluation  # it imports jax
    from starjax.policies import in_env

    if named.run is None:
        who = in_env.load(named.file, in_env.read(named.file), arms=arms)
        return who, _settings(who.trained)
    config = folders.read_config(named.run)
    who = policy_evaluation.load(named.run.name, named.file, arms=arms)
    return who, policy_evaluation.settings(who, config)


def _settings(trained: Any) -> config_lib.RunConfig:
    """Settings of the run that a policy comes from, as far as its file knows them."""
    known = {
        "method": trained.method,
        "preset": trained.preset or "auto",
        "policy": config_lib.as_json(trained.policy),
        "train": config_lib.as_json(trained.train),
        "demos": config_lib.as_json(trained.demos or config_lib.DemosConfig()),
        "scene": config_lib.as_json(scenes.settings(trained.scene)),
    }
    unknown: dict[str, Any] = {"seed": None}  # no file of weights says it
    found = config_lib.from_dict(config_lib.RunConfig, known)
    return dataclasses.replace(found, **unknown)
