"""Checks of a camera in each task that has it: its lens, and the tip's start in its picture."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from starjax.sim import endoscope_camera, mjcf_parts, registries
from starjax.sim import scene as scenes
from starjax.testing.base import Check, attempt, verdict


def check(name: str, n: int) -> Iterator[Check]:
    """Yields the checks of a camera in every task that names it; `n` is not used."""
    for task_name in registries.tasks.names():
        fault, task = attempt(task_name, lambda t=task_name: registries.tasks.get(t))
        if not fault and name in task.cameras:
            yield _in_task(name, task_name)


def _in_task(name: str, task_name: str) -> Check:
    subject, task = f"in {task_name}", registries.tasks.get(task_name)
    fault, m = attempt(subject, lambda: scenes.compose(scenes.name(task_name, cameras=(name,))))
    if fault:
        return fault
    (camera,) = mjcf_parts.ids(subject, m, "camera", [name])
    data = mujoco.MjData(m)
    mujoco.mj_forward(m, data)
    fovy = float(m.cam_fovy[camera])
    if m.cam_bodyid[camera] or endoscope_camera.of(task, (name,)):
        return verdict(subject, _lens(fovy), f"moves, {fovy:g} deg")
    layout = task.sample(task.bind(m), jax.random.key(0))
    tips = task.tips(task.bind(m), layout, jnp.array([slot.p_world_ref for slot in task.slots]))
    R, p = data.cam_xmat[camera].reshape(3, 3), data.cam_xpos[camera]
    in_view = (np.asarray(tips) - p) @ R  # x to the right, y up, looking along -z
    edge = np.tan(np.radians(fovy) / 2) * -in_view[:, 2:]
    outside = (in_view[:, 2] >= 0) | (np.abs(in_view[:, :2]) > edge).any(axis=1)
    faults = [
        *_lens(fovy),
        *(f"the tip of arm {a} starts outside" for a in np.flatnonzero(outside)),
    ]
    return verdict(subject, faults, f"{fovy:g} deg, the tips' start is in the picture")


def _lens(fovy: float) -> list[str]:
    return [] if 0 < fovy < 180 else [f"fovy {fovy:g}"]
