"""A trained policy in a program of one's own (`policy.load`)."""

from starjax.deploy.policy import (
    FARTHEST,
    Command,
    Deployed,
    Observation,
    Pose,
    load,
)

__all__ = ["FARTHEST", "Command", "Deployed", "Observation", "Pose", "load"]
