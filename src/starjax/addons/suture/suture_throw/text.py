"""Phrases of suture throw, for reports."""

from starjax.sim.task import TaskText

TEXT = TaskText(
    title="suture throw",
    done="threw the suture",
    strict="in at one mark and out at the other within 1 mm, with at most 0.4 N across the hole, "
    "needle taken out by its point, 50 mm of thread pulled through, nothing touched by shaft or "
    "wrist, in time",
    loose="the whole needle passed the pad",
    nearly="needle passed through, but off a mark, with force, a collision or too little thread",
    collided="pressed the wrist or the shaft into the pad",
    ground="the pad",
    goal="the needle goes in at the dark mark and out at the blue one",
    lost="the needle was dropped",
)
