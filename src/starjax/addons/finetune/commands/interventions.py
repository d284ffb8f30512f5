"""Episodes in which a person relieved a policy, as `starjax finetune` takes them."""

from pathlib import Path

from starjax.addons.finetune import dagger
from starjax.addons.finetune.settings import FinetuneConfig
from starjax.core import errors
from starjax.data import store
from starjax.rcm.trocar import Trocar
from starjax.sim.rollouts import takeover
from starjax.sim.state import Env

_FLAG = "--interventions"


def find(settings: FinetuneConfig, env: Env, seen: Trocar) -> Path:
    """Returns the folder of the settings' interventions.

    Args:
      settings: of the fine-tuning.
      env: of the policy.
      seen: the trocars of its demonstrations.

    Raises:
      errors.UsageError: another way than dagger, no such dataset, another task, no success, or an
        episode at a trocar that the policy has not seen.
    """
    if settings.by != dagger.NAME:
        raise errors.UsageError(_FLAG, "--by dagger", f"--by {settings.by}")
    root = Path(settings.interventions)
    try:
        description = store.read_description(root)
        records = [store.verify(root, key) for key in store.keys(root)]
    except (FileNotFoundError, KeyError, TypeError, ValueError) as error:
        hint = "starjax teleop --policy makes one"
        raise errors.UsageError(_FLAG, "a dataset of interventions", error, hint) from error
    if description.get("learned") != takeover.INTERVENTION:
        hint = "starjax teleop --policy makes one"
        raise errors.UsageError(_FLAG, "a dataset of interventions", f"another, {root}", hint)
    task = description["scene"]["task"]
    if task != env.task.name:
        raise errors.UsageError(_FLAG, f"interventions in {env.task.name}", task)
    learned = [record for record in records if record["success"]]
    if not learned:
        raise errors.UsageError(_FLAG, "a successful episode", f"none in {root}")
    count = len(seen.radius)
    if others := [record["key"] for record in learned if record["trocar"] >= count]:
        expected = f"episodes at the seen trocars, 0 to {count - 1}"
        raise errors.UsageError(_FLAG, expected, others[0])
    return root
