"""The policy of a method: what its row says, learned as the settings say."""

from collections.abc import Sequence

from starjax import config, methods, rcm
from starjax.policies import features, hierarchical, single
from starjax.policies.base import Params, Policy
from starjax.sim.tasks.base import Task

__all__ = ["Params", "Policy", "ablated", "make"]


def ablated(method: methods.Method, policy_config: config.PolicyConfig) -> methods.Method:
    """The row as settings change it: what it sees and how its poses are written."""
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
    """The policy of a method.

    Args:
      method: a row of `methods.METHODS`.
      policy_config: networks, and the learner.
      task: gives the number of arms, and what a state observation is made of.
      train_config: augmentation, which inference does not need.
      cameras: that are observed, in the order in which the networks read them; empty: the task's
        first one.
    """
    method = ablated(method, policy_config)
    build = hierarchical.make if method.hierarchical else single.make
    sensors = features.select_sensors(task, cameras)
    return build(method, policy_config, sensors, train_config or config.TrainConfig())
