"""Ranges that actions in [-1, 1] span in a task's action space."""

import jax
import numpy as np

from starjax import rcm
from starjax.sim import registries
from starjax.sim.task import Task

# Margins of the workspace's box of the tip (m) and of its rolls (rad): goals at the edge are inside
# the range, and a command past the goal speeds the tool up.
MARGIN = np.array([0.005, 0.005, 0.015])
ROLL_MARGIN = 0.2
AZIMUTHS, ROLLS, TIPS = 16, 9, 3  # sizes of the grid, a side


def tips(task: Task) -> tuple[np.ndarray, np.ndarray]:
    """Returns the tips' boxes, low and high `[A, 3]` m in the world.

    They are the workspaces' boxes with MARGIN added, except downwards.
    """
    spaces = [registries.workspaces.get(slot.workspace) for slot in task.slots]
    low, high = (np.array([getattr(space, end) for space in spaces]) for end in ("low", "high"))
    return low - MARGIN * [1, 1, 0], high + MARGIN


def actions(task: Task, space: rcm.ActionSpace) -> tuple[np.ndarray, np.ndarray]:
    """Returns the lowest and highest encodings `[A, dim]` of poses with the tip in its box.

    All poses are on the RCM manifold, through trocars at the edge of the workspace's ranges, with
    rolls of the workspace and ROLL_MARGIN. So the task bounds positions, depths and rolls, and the
    middle of the box is near a tool that points down.

    In a space of a wrist angles span its limits, rolls half a turn, and rotations are free.
    """
    encode = jax.jit(space.encode)
    bounds = []
    for slot, low, high in zip(task.slots, *tips(task), strict=True):
        work = registries.workspaces.get(slot.workspace)
        turn = np.linspace(*work.azimuth, num=AZIMUTHS)
        # Extremes of smooth maps lie at the ranges' ends, or near enough on this grid.
        edge = np.meshgrid(work.radius, [*work.polar, np.mean(work.polar)], turn)
        trocar = rcm.Trocar(*(x.ravel()[:, None] for x in edge))
        frame = rcm.trocar_frame(trocar, np.array(slot.p_world_ref), slot.roll_zero)
        rolls = np.linspace(work.rolls[0] - ROLL_MARGIN, work.rolls[1] + ROLL_MARGIN, ROLLS)
        axes = [rolls, *np.linspace(low, high, TIPS).T]
        poses = np.stack([x.ravel() for x in np.meshgrid(*axes)], axis=-1)
        pose, _ = rcm.ACTION_SPACES["rcm4"].decode(poses[None], frame)
        encoded = np.asarray(encode(pose, frame)).reshape(-1, space.dim)
        lowest, highest = encoded.min(axis=0), encoded.max(axis=0)
        bounds.append((lowest, highest))
        if space.for_wrist is not None:
            _widen(space, lowest, highest, registries.tools.get(slot.tool).wrist)
    low, high = (np.stack(ends).astype(np.float32) for ends in zip(*bounds, strict=True))
    return low, high


def _widen(space: rcm.ActionSpace, low: np.ndarray, high: np.ndarray, wrist: rcm.Wrist) -> None:
    """Widens the bounds `[dim]` of straight tools, in place, to those of a wrist."""
    most = {
        "R": 1.0,
        "roll": 0.5 * np.pi + ROLL_MARGIN,
        "wrist": np.array([wrist.pitch, wrist.yaw]),
    }
    for part, limit in most.items():
        if part in space.slices:
            where = space.slices[part]
            low[where] = np.minimum(low[where], -limit)
            high[where] = np.maximum(high[where], limit)
