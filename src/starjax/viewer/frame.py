"""One moment of a rollout, as the page shows it, whether simulated now or recorded."""

from typing import Any, NamedTuple

import numpy as np


class Frame(NamedTuple):
    """One moment, on the host.

    Attributes:
      step: control steps taken.
      qpos: `[Q]`.
      p_world_trocar: `[A, 3]` m.
      p_world_tip: `[A, 3]` m, measured.
      rcm_error: `[A]` m, executed.
      rgb: `[G, 3]` colours in [0, 1], the goal marked.
      plan: `[H, A, 3]` m, tips of the commands ahead, the next one first; H may be 0.
      stage: index of the task's stages. reward: in [0, 1].
      done, success, invalid, collided: see `sim.state.EnvState`.
    """

    step: Any
    qpos: Any
    p_world_trocar: Any
    p_world_tip: Any
    rcm_error: Any
    rgb: Any
    plan: Any
    stage: Any
    reward: Any
    done: Any
    success: Any
    invalid: Any
    collided: Any


def outcome(frame: Frame, is_late: bool = False) -> str:
    """How a rollout ended, or an empty string while it goes on."""
    if frame.invalid:
        return "invalid: the simulation diverged"
    if frame.success:
        return "success, with a collision" if frame.collided else "success"
    if frame.done:
        return "lost"
    return "out of time" if is_late else ""


def millimetres(metres: Any) -> np.ndarray:
    """m as mm."""
    return 1e3 * np.asarray(metres, np.float64)
