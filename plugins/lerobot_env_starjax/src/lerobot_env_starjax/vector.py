"""The environment of an export's columns, with the calls that LeRobot makes of its lanes."""

from typing import Any

from starjax.addons.formats import exported


class LeRobotVectorEnv(exported.ExportedVectorEnv):
    """N episodes side by side; `call` answers for every lane."""

    def __init__(self, num_envs: int, **arguments: Any) -> None:
        super().__init__(num_envs, render_mode="rgb_array", **arguments)
        self._attributes = {
            "task": self.settings.task,
            "task_description": self.settings.task.replace("_", " "),
            "_max_episode_steps": self.episodes.max_steps,
        }

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Returns an attribute, or the images of `render`, of every lane."""
        if name == "render":
            return self.render() or ()
        if name not in self._attributes:
            raise AttributeError(name)
        return (self._attributes[name],) * self.num_envs

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Returns an attribute of every lane."""
        return self.call(name)
