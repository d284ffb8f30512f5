"""Phrases and drawing of peg transfer, for reports."""

from typing import TYPE_CHECKING

from starjax.sim.task import Outline, TaskText
from starjax.tasks import outlines

if TYPE_CHECKING:  # a robot loads tasks without the simulator
    import mujoco

TEXT = TaskText(
    title="peg transfer",
    done="moved the block to its peg",
    strict="on the target peg, released, at rest, in time",
    loose="SurRoL's test: the block was near its place on the target peg",
    nearly="block at its peg, but not threaded, released and at rest",
    collided="touched the board, a peg or the block with the shaft or an arm",
    ground="the boards",
    goal="the block belongs on the marked peg",
)
BOARDS = ("board_source", "board_target")


def outline(mj_model: "mujoco.MjModel") -> Outline:
    """Returns the boards' rectangles and the pegs."""
    areas = tuple(outlines.rectangle(mj_model, name) for name in BOARDS)
    # A peg is a capsule along z: its cap ends the size and half the length above its middle.
    lines = tuple(
        outlines.stick(peg.pos, peg.pos[2] + peg.size.sum())
        for peg in outlines.named(mj_model, "peg")
    )
    return Outline(areas, lines)
