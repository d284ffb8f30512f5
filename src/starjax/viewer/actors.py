"""Who acts in the view: a scripted expert or a trained policy, by name."""

from pathlib import Path
from typing import Any, NamedTuple

from starjax import errors, methods
from starjax.policies import packaged, policy_file
from starjax.policies import policy as policies
from starjax.rollouts import agent
from starjax.sim import env as sim_env
from starjax.sim import registry
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
    slots = registry.tasks.get(task).slots
    return Actor(EXPERT, task, None, tuple(slot.arm for slot in slots))


def from_file(file: Path, name: str = "") -> Actor:
    """A trained policy.

    Raises:
      errors.UsageError: the file is damaged, or not a policy of this version.
    """
    trained = _read(file)
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
    trained = _read(who.file)
    settings, scene = trained.policy, trained.scene
    env = sim_env.make(
        scene.task,
        arms or scene.arms,
        scene.tools,
        observation=settings.observation,
        image_size=settings.image_size,
        cameras=scene.cameras,
    )
    row = methods.METHODS[trained.method]
    policy = policies.make(row, settings, env.task, cameras=scene.cameras)
    planner = agent.from_policy(policy.sample, settings.obs_horizon, settings.execute)
    params = (policy.for_sampling(trained.params), trained.normalizer)
    return simulation.make(who.label, env, planner, params)


def _read(file: Path) -> Any:
    try:
        trained = policy_file.load(file)
    except ValueError as error:
        raise errors.UsageError("--policy", "a policy of starjax", error) from error
    errors.choice(f"method of {file}", trained.method, methods.METHODS)
    return trained
