"""Trained policies in other programs: in this process (`load`) or over a socket (`Client`)."""

from starjax.core.types import Command, Pose
from starjax.deploy.client import Client
from starjax.deploy.guard import Doubt, Tolerances
from starjax.deploy.images import square
from starjax.deploy.in_process import drive
from starjax.deploy.inputs import FARTHEST
from starjax.deploy.inputs import RobotObservation as Observation
from starjax.deploy.plan_executor import Limits, Report
from starjax.deploy.policy import Deployed, load
from starjax.deploy.robot import Robot

__all__ = [
    "FARTHEST",
    "Client",
    "Command",
    "Deployed",
    "Doubt",
    "Limits",
    "Observation",
    "Pose",
    "Report",
    "Robot",
    "Tolerances",
    "drive",
    "load",
    "square",
]
