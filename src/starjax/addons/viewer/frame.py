"""One control step of a rollout as the page shows it, simulated or recorded."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np

from starjax.core.types import Pose
from starjax.sim import registries, scene
from starjax.sim.camera import geometry
from starjax.sim.names import SceneNames


class Frame(NamedTuple):
    """State of a rollout after a control step, on the host.

    Attributes:
      step: control steps taken.
      qpos: `[Q]` generalised coordinates.
      p_world_trocar: `[A, 3]` in m.
      p_world_tip: `[A, 3]` in m, measured.
      rcm_error: `[A]` in m, executed.
      rgb: `[G, 3]` colours in [0, 1], the goal marked.
      plan: `[H, A, 3]` in m, tips of the commands ahead, the next one first; H may be 0.
      stage: index into the task's stages.
      reward: in [0, 1].
      done: true after the end, see `sim.state.EnvState`.
      success: strict success.
      invalid: true if the simulation diverged.
      collided: true after a collision.
      gripper: `[A]` measured openings in [-1, 1], None in a recording without them.
      still: Pose `[K]` of the task's bodies at rest, see `sim.still_bodies`, or None.
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
    gripper: Any = None
    still: Any = None


def outcome(frame: Frame, is_late: bool = False) -> str:
    """Returns the outcome of a rollout, or an empty string while it runs."""
    if frame.invalid:
        return "invalid: the simulation diverged"
    if frame.success:
        return "success, with a collision" if frame.collided else "success"
    if frame.done:
        return "lost"
    return "out of time" if is_late else ""


def rcm_error_mm(frame: Frame) -> float:
    """Returns the largest RCM error of the arms in mm."""
    return 1e3 * float(np.max(frame.rcm_error))


def colours(names: SceneNames, model: mujoco.MjModel, labels: Mapping[str, int]) -> np.ndarray:
    """Returns the colours `[G, 3]` of a scene, the goal of an episode marked."""
    task, rgb = registries.tasks.get(names.task), jnp.asarray(geometry.geom_rgb(model))
    return np.asarray(scene.marked(task, task.bind(model), labels, rgb))


def from_arrays(
    qpos: np.ndarray,
    p_world_trocar: np.ndarray,
    p_world_tip: np.ndarray,
    rcm_error: np.ndarray | None,
    rgb: np.ndarray,
    still: Pose | None = None,
) -> list[Frame]:
    """Makes frames of T recorded control steps.

    Args:
      qpos: `[T, Q]`.
      p_world_trocar: `[A, 3]` in m.
      p_world_tip: `[T, A, 3]` in m.
      rcm_error: `[T, A]` in m, zeros if unknown.
      rgb: `[G, 3]` in [0, 1].
      still: see `Frame`.
    """
    error = np.zeros(p_world_tip.shape[:2]) if rcm_error is None else rcm_error
    plan = np.zeros((0, *p_world_tip.shape[1:]))
    return [
        Frame(
            t, qpos[t], p_world_trocar, tip, error[t], rgb, plan, 0, 0.0, *[False] * 4, still=still
        )
        for t, tip in enumerate(p_world_tip)
    ]
