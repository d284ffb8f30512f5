"""A trained policy in a program of one's own (`load`), or served to robots elsewhere (`Client`)."""

from starjax.deploy.client import Client, Robot
from starjax.deploy.follow import Limits, Report
from starjax.deploy.measured import FARTHEST, Observation
from starjax.deploy.policy import Deployed, load
from starjax.types import Command, Pose

__all__ = [
    "FARTHEST",
    "Client",
    "Command",
    "Deployed",
    "Limits",
    "Observation",
    "Pose",
    "Report",
    "Robot",
    "load",
]
