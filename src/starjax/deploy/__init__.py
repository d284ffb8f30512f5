"""A trained policy in a program of one's own (`policy.load`)."""

from starjax.deploy.measured import FARTHEST, Observation
from starjax.deploy.policy import Deployed, load
from starjax.types import Command, Pose

__all__ = ["FARTHEST", "Command", "Deployed", "Observation", "Pose", "load"]
