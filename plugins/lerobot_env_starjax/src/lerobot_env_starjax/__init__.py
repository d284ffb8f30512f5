"""Tasks of starjax as environments of LeRobot: `lerobot-eval --env.type=starjax`."""

import dataclasses
from typing import Any

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE, OBS_STR

from lerobot_env_starjax.vector import LeRobotVectorEnv


@EnvConfig.register_subclass("starjax")
@dataclasses.dataclass
class StarjaxEnv(EnvConfig):
    """Options of the environment.

    Attributes:
      task: of `starjax list`.
      fps: control steps per second, 30.
      trocars: groups of trocars, each scored apart: seen, unseen, all, random.
      observation: image or state.
      image_size: pixels per side.
      trocar_in_state: append the trocar to `observation.state`.
      actions: pose or rcm4, see `starjax export --actions`.
      max_episode_steps: control steps; None: the task's time limit.
    """

    task: str | None = "peg_transfer"
    fps: int = 30
    trocars: str = "seen,unseen"
    observation: str = "image"
    image_size: int = 256
    trocar_in_state: bool = False
    actions: str = "pose"
    max_episode_steps: int | None = None

    def __post_init__(self) -> None:
        """Fills in the features, whose shapes are those of the task."""
        from starjax.addons.formats import exported
        from starjax.sim import registries

        task = registries.tasks.get(str(self.task))
        observed, action = exported.sizes(task, self.actions, self.trocar_in_state)
        rows = {
            ACTION: (FeatureType.ACTION, (action,), ACTION),
            "agent_pos": (FeatureType.STATE, (observed["agent_pos"],), OBS_STATE),
            "trocar": (FeatureType.STATE, (observed["trocar"],), f"{OBS_STR}.trocar"),
        }
        if self.observation == "image":
            size, camera = (self.image_size, self.image_size, 3), task.cameras[0]
            rows[f"pixels/{camera}"] = (FeatureType.VISUAL, size, f"{OBS_IMAGES}.{camera}")
        else:
            rows["environment_state"] = (FeatureType.ENV, (task.state_size,), OBS_ENV_STATE)
        self.features = {n: PolicyFeature(type=t, shape=shape) for n, (t, shape, _) in rows.items()}
        self.features_map = {name: key for name, (_, _, key) in rows.items()}

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Returns the arguments of the environment without its trocars."""
        return {
            "task": self.task,
            "observation": self.observation,
            "image_size": self.image_size,
            "trocar_in_state": self.trocar_in_state,
            "actions": self.actions,
            "max_episode_steps": self.max_episode_steps,
        }

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, LeRobotVectorEnv]]:
        """Makes an environment of `n_envs` lanes for each group of trocars."""
        groups = [name.strip() for name in self.trocars.split(",")]
        return {
            group: {0: LeRobotVectorEnv(n_envs, trocar=group, **self.gym_kwargs)}
            for group in groups
        }
