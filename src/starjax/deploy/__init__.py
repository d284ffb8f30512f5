"""Trained policies in other programs: in this process (`load`) or over a socket (`Client`)."""

from starjax.deploy.client import Client, Robot
from starjax.deploy.inputs import FARTHEST
from starjax.deploy.inputs import RobotObservation as Observation
from starjax.deploy.plan_executor import Limits, Report
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
