"""Phrases and drawing of reach, for reports."""

from typing import Any

from starjax.sim.task import Outline, TaskText
from starjax.tasks import outlines

TEXT = TaskText(
    title="reach",
    done="brought the tip to the marked point",
    strict="within 2 mm of the marked point and at rest for 1 s, in time",
    loose="the tip was within 5 mm of the marked point, moving or not",
    nearly="near the marked point, but not at rest on it",
    collided="touched the pad, or a post with the shaft",
    ground="the pad",
    goal="the tip belongs on the coloured mark",
)


def outline(mj_model: Any) -> Outline:
    """Returns the pad's rectangle and the posts."""
    marks = [mark.pos for mark in outlines.named(mj_model, "mark")]
    lines = tuple(outlines.stick(mark, mark[2]) for mark in marks)
    return Outline((outlines.rectangle(mj_model, "pad"),), lines)
