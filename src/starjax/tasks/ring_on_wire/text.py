"""Phrases and drawing of ring on wire, for reports."""

from typing import Any

from starjax.sim.task import Outline, TaskText
from starjax.tasks import outlines

TEXT = TaskText(
    title="ring on wire",
    done="carried the ring along the wire to its end",
    strict="at the marked end of the wire, released and at rest, having touched the bent part for "
    "0.3 s at most, in time",
    loose="the ring came to the marked end, however often it touched the wire",
    nearly="ring at the marked end, but not released and at rest there",
    collided="touched the base or the wire with the shaft or an arm",
    ground="the base",
    goal="the ring belongs at the marked end of the wire",
    lost="the ring touched the bent part of the wire for longer than 0.3 s",
)


def outline(mj_model: Any) -> Outline:
    """Returns the base's rectangle and the wire."""
    pieces = tuple(map(outlines.capsule_ends, outlines.named(mj_model, "wire", "post")))
    return Outline((outlines.rectangle(mj_model, "base"),), pieces)
