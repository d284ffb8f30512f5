"""Phrases and drawing of needle drive, for reports."""

from typing import TYPE_CHECKING

from starjax.sim.task import Outline, TaskText
from starjax.tasks import outlines

if TYPE_CHECKING:  # a robot loads tasks without the simulator
    import mujoco

TEXT = TaskText(
    title="needle drive",
    done="drove the needle through the pad",
    strict="in at one mark and out at the other within 1 mm, 3 mm of wire out, with at most 0.4 N "
    "across the hole, nothing touched by shaft or wrist, in time",
    loose="the needle's point left the pad",
    nearly="needle driven through, but off a mark, with force, or with a collision",
    collided="pressed the wrist or the shaft into the pad",
    ground="the pad",
    goal="the needle goes in at the dark mark and out at the blue one",
    lost="the needle was dropped",
)


def outline(mj_model: "mujoco.MjModel") -> Outline:
    """Returns the pad's rectangle."""
    return Outline((outlines.rectangle(mj_model, "pad"),), ())
