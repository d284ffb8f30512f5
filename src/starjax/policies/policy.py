"""Policies of methods: a row of the table and the settings give pure functions."""

from collections.abc import Sequence

from starjax import rcm
from starjax.core import config, methods
from starjax.policies import features, hierarchical, single
from starjax.policies.base import Params, Policy
from starjax.sim.task import Task

__all__ = ["Params", "Policy", "ablated", "make"]


def ablated(method: methods.Method, policy_config: config.PolicyConfig) -> methods.Method:
    """Returns the row with the ablations of the settings: trocar condition and frame {T}."""
    if policy_config.sees_trocar != "method":
        method = method._replace(sees_trocar=policy_config.sees_trocar == "always")
    fixed = f"{method.action_space}_fixed_yaw"
    if policy_config.trocar_yaw == "fixed" and fixed in rcm.ACTION_SPACES:
        method = method._replace(action_space=fixed)
    return method


def make(
    method: methods.Method,
    policy_config: config.PolicyConfig,
    task: Task,
    train_config: config.TrainConfig | None = None,
    cameras: Sequence[str] = (),
) -> Policy:
    """Builds the policy of a method.

    Args:
      method: a row of `methods.METHODS`.
      policy_config: networks, and the learner.
      task: number of arms and fields of the state.
      train_config: augmentation, which inference does not need.
      cameras: observed cameras in the networks' order; by default the task's first one.
    """
    method = ablated(method, policy_config)
    build = hierarchical.make if method.hierarchical else single.make
    sensors = features.select_sensors(task, cameras)
    return build(method, policy_config, sensors, train_config or config.TrainConfig())
