"""Robots as `Client.run` and `drive` see them."""

from typing import Protocol

from starjax.core.types import Command
from starjax.deploy.inputs import RobotObservation


class Robot(Protocol):
    """A robot that `Client.run` can drive."""

    def measure(self) -> RobotObservation:
        """Measures pose `[*arms]`, gripper `[*arms]`, and image `[h, w, 3]`, images or state."""
        ...

    def send(self, command: Command) -> None:
        """Takes a command `[*arms]`, to be reached by the next one; none comes while in doubt."""
        ...
