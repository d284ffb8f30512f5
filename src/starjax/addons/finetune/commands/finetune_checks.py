"""Policies that a way of fine-tuning cannot improve: refused before anything runs."""

from pathlib import Path

from starjax.addons.finetune import dagger
from starjax.addons.finetune.commands import interventions
from starjax.addons.finetune.settings import FinetuneConfig
from starjax.core import config as config_lib
from starjax.core import errors
from starjax.data import store
from starjax.rcm.trocar import Trocar
from starjax.sim.state import Env
from starjax.sim.task import Task

OF_ONE_STEP = ("rl", "distill")  # ways that need a learner of one evaluation
_ONE_STEP = "onestep"  # that learner


def check(
    settings: FinetuneConfig,
    config: config_lib.RunConfig,
    policy: config_lib.PolicyConfig,
    env: Env,
    seen: Trocar,
) -> None:
    """Checks the settings of a fine-tuning against its policy.

    Args:
      settings: of the fine-tuning.
      config: of the policy's run.
      policy: settings of the policy.
      env: of the policy.
      seen: the trocars of its demonstrations.

    Raises:
      errors.UsageError: the learner, the task's expert or the interventions do not suit the way.
    """
    if settings.by in OF_ONE_STEP and policy.learner != _ONE_STEP:
        expected = f"a policy of the learner {_ONE_STEP}"
        raise errors.UsageError(f"--by {settings.by}", expected, policy.learner)
    if settings.by == dagger.NAME:
        dagger.rescuer(env.task, demonstrator(config, env.task))
    if settings.interventions:
        interventions.find(settings, env, seen)


def demonstrator(config: config_lib.RunConfig, task: Task) -> str:
    """Returns the expert of a run's demonstrations, empty for the task's first."""
    if not config.demos.from_:
        return config.demos.expert
    try:
        found = store.read_description(Path(config.demos.from_)).get("expert", "")
    except (OSError, ValueError):  # loading the demonstrations names it
        return ""
    return found if found in task.experts else ""
