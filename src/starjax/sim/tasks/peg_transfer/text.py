"""Phrases and drawing of peg transfer, for reports."""

from typing import Any

import numpy as np

from starjax.sim.tasks.base import Outline, TaskText

TEXT = TaskText(
    title="peg transfer",
    done="moved the block to its peg",
    strict="on the target peg, released, at rest, in time",
    loose="SurRoL's test: the block was near its place on the target peg",
    nearly="block at its peg, but not threaded, released and at rest",
    collided="touched board, peg or block with shaft or arm",
    ground="the boards",
    goal="the block belongs on the marked peg",
)
BOARDS = ("board_source", "board_target")


def outline(mj_model: Any) -> Outline:
    """Reads the boards' rectangles and the pegs from the compiled model.

    Args:
      mj_model: `mujoco.MjModel` with this task in it.
    """
    boards = (mj_model.geom(name) for name in BOARDS)
    areas = tuple(geom.pos * [1, 1, 0] + geom.size * _CORNERS for geom in boards)
    names = (mj_model.geom(i).name for i in range(mj_model.ngeom))
    pegs = (mj_model.geom(name) for name in names if name.startswith("peg"))
    # A peg is a capsule along z: its cap ends the size and half the length above its middle.
    lines = tuple(_stick(peg.pos, peg.pos[2] + peg.size.sum()) for peg in pegs)
    return Outline(areas, lines)


_CORNERS = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])


def _stick(foot: np.ndarray, height: float) -> np.ndarray:
    """A line `[2, 3]` from the ground to `height` m above `foot`."""
    return np.array([[foot[0], foot[1], 0.0], [foot[0], foot[1], height]])
