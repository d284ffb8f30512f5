"""Who acts in the view: a scripted expert or a trained policy, by name."""

from pathlib import Path
from typing import NamedTuple

from starjax import methods
from starjax.policies import in_env, packaged
from starjax.rollouts import agent
from starjax.sim import env as sim_env
from starjax.sim import registries
from starjax.viewer import simulation

EXPERT = "expert"
IMAGE_SIZE = 128  # pixels a side of an expert's picture; a policy's is the one that it sees


class Actor(NamedTuple):
    """Somebody who can act.

    Attributes:
      label: for people.
      task: that they do.
      file: of the policy's weights, or None for the expert.
      arms: that the policy was trained with.
    """

    label: str
    task: str
    file: Path | None
    arms: tuple[str, ...]


def expert(task: str) -> Actor:
    """The task's scripted demonstrator."""
    slots = registries.tasks.get(task).slots
    return Actor(EXPERT, task, None, tuple(slot.arm for slot in slots))


def from_file(file: Path, name: str = "") -> Actor:
    """A trained policy.

    Raises:
      errors.UsageError: the file is damaged, or not a policy of this version.
    """
    trained = in_env.read(file)
    label = methods.METHODS[trained.method].label
    return Actor(
        f"{label} ({name or file.parent.name})", trained.scene.task, file, trained.scene.arms
    )


def known(task: str) -> list[Actor]:
    """The expert, and the policies for this task that ship with the package."""
    found = [from_file(packaged.locate(name), name) for name in packaged.names()]
    return [expert(task), *(actor for actor in found if actor.task == task)]


def simulate(who: Actor, arms: tuple[str, ...] = ()) -> simulation.Simulation:
    """The closed loop of an actor, with other robots than theirs if `arms` are named."""
    if who.file is None:
        env = sim_env.make(who.task, arms, observation="state", image_size=IMAGE_SIZE)
        scripted = next(iter(env.task.experts.values()))()
        return simulation.make(who.label, env, agent.from_single(scripted))
    played = in_env.load(who.file, in_env.read(who.file), arms=arms)
    params = (played.trained.params, played.trained.normalizer)
    return simulation.make(who.label, played.env, played.agent(), params)
