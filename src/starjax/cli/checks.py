"""Checks settings against each other, before anything heavy is imported.

The range of each is on the field (`limits`).
"""

import os
from pathlib import Path
from typing import Any

from starjax.core import config as config_lib
from starjax.core import errors, methods
from starjax.core.learners import ENCODERS, LEARNERS
from starjax.evaluation import disturbances

API_KEY = "STARJAX_API_KEY"  # environment variable with the key of a server
# Pixels that an encoder makes one of its maps' cells.
_CELL = {"resnet18": 32, "small": 8, "points": 2}


def check(config: config_lib.RunConfig) -> None:
    """Raises UsageError for the first setting that does not go with another."""
    for name in config.method.split(","):
        errors.choice("method", name, [*methods.METHODS, "all"])
    policy = config.policy
    errors.choice("policy.encoder", policy.encoder, ENCODERS.names())
    if policy.depth_encoder:
        errors.choice("policy.depth_encoder", policy.depth_encoder, ENCODERS.names())
    LEARNERS.get(policy.learner).check(policy.options, policy)
    for name, most, of in (
        ("execute", policy.horizon, "policy.horizon"),
        ("obs_horizon", policy.execute + 1, "policy.execute + 1"),
    ):
        value = getattr(policy, name)
        expect(value <= most, f"policy.{name}", f"at most {of} = {most}", value)
    planned = not config.eval.ensemble or policy.obs_horizon <= 2
    expect(planned, "policy.obs_horizon", "at most 2 with eval.ensemble", policy.obs_horizon)
    if policy.observation == "image":
        encoder, fraction = policy.encoder, policy.crop_fraction
        cell = _CELL.get(encoder) or ENCODERS.get(encoder).cell  # imports jax
        crop = round(policy.image_size * fraction)
        left = f"more than {cell} pixels left by policy.crop_fraction = {fraction:g}"
        expect(crop > cell, "policy.image_size", left, crop)
    for name in ("encoder_weights", "freeze_encoder", "depth_encoder"):
        sees = policy.observation == "image" or not getattr(policy, name)
        expect(sees, f"policy.{name}", "policy.observation image", policy.observation)
    levels = disturbances.parse_levels("demos.randomise", config.demos.randomise)
    ours = not (levels and config.demos.from_)
    expect(ours, "demos.randomise", "the expert's demonstrations", config.demos.from_)
    disturbances.parse_levels("train.randomise", config.train.randomise)
    learns = not (policy.freeze_encoder and policy.depth_encoder)
    expect(learns, "policy.depth_encoder", "none with policy.freeze_encoder", policy.depth_encoder)
    trained = bool(policy.encoder_weights) or not policy.freeze_encoder
    expect(trained, "policy.freeze_encoder", "policy.encoder_weights of a trained policy", "none")


def expect_folder(argument: str, name: str | Path) -> None:
    """Raises UsageError for `argument` unless files can be written in a folder of this name.

    It may be missing, where it can be made. Nothing is made here: a command that ends with another
    mistake leaves none behind.
    """
    expect(str(name) != "", argument, "a folder", "nothing")
    path = Path(name)
    for place in (path, *path.parents):
        try:
            place.lstat()
        except (FileNotFoundError, NotADirectoryError, PermissionError):
            continue  # decided by the directory above
        except OSError as error:
            raise errors.UsageError(argument, "a folder", f"{path}: {error.strerror}") from error
        above = place != path
        if not place.is_dir():
            raise errors.UsageError(argument, "a folder", path, f"{place} is not one" * above)
        if not os.access(place, os.W_OK | os.X_OK):
            expected = "a folder that may be written"
            raise errors.UsageError(argument, expected, path, f"{place} may not" * above)
        return


def expect(holds: bool, argument: str, expected: str, got: Any) -> None:
    """Raises UsageError for `argument` unless its value `holds`."""
    if not holds:
        raise errors.UsageError(argument, expected, got)
