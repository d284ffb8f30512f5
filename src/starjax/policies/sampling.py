"""Options of a policy's learner that change its samples, not its weights."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from starjax.core import config, config_json, errors, limits, methods
from starjax.core.learners import LEARNERS
from starjax.policies import policy as policies
from starjax.policies import policy_file
from starjax.sim import registries, wrists


def changed(settings: config.PolicyConfig, options: Mapping[str, Any]) -> config.PolicyConfig:
    """Replaces options of the learner; raises UsageError for unknown ones or invalid values."""
    names = [field.name for field in dataclasses.fields(settings.options)]
    values = {}
    for name, value in options.items():
        errors.choice("option", name, names)
        values[name] = value.item() if isinstance(value, np.generic) else value
    new = config_json.from_dict(config.PolicyConfig, {**config_json.as_json(settings), **values})
    limits.check(new)
    LEARNERS.get(new.learner).check(new.options, new)
    return new


def applied(
    argument: str, trained: policy_file.Trained, options: Mapping[str, Any]
) -> policy_file.Trained:
    """Returns a policy with other options, without its monitor, which is of the old samples.

    Raises:
      errors.UsageError: an option is unknown, out of range or one of the weights.
    """
    if not options:
        return trained
    new = changed(trained.policy, options)
    row = methods.METHODS[trained.method]
    task = wrists.holding(registries.tasks.get(trained.scene.task), trained.scene)

    def shapes(settings: config.PolicyConfig) -> Any:
        made = policies.make(row, settings, task, cameras=trained.scene.cameras)
        return jax.eval_shape(made.init, jax.random.key(0))

    if shapes(new) != shapes(trained.policy):
        raise errors.UsageError(argument, "options that keep the weights", ", ".join(options))
    return trained._replace(policy=new, monitor=None)
