"""C MuJoCo on one thread: the physics' peer."""

from collections.abc import Sequence
from typing import Literal

import _timing
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from starjax.sim import physics
from starjax.sim.scene import Scene

STEPS = 128  # a timed call


def at_rest(scene: Scene) -> physics.PhysicsState:
    """Arms at home, the task's objects where an episode begins."""
    layout = scene.task.sample(scene.bound, jax.random.key(0))
    return physics.initial(scene, [arm.home for arm in scene.arms], layout)


def servos(scene: Scene, q: Sequence[jax.Array], jaws: Literal["open", "closed"]) -> jax.Array:
    """The servos' targets `[nu]` that hold the arms at `q`, `[J]` rad each."""
    ctrl = jnp.zeros(scene.mj_model.nu)
    for arm, q_arm in zip(scene.arms, q, strict=True):
        ctrl = ctrl.at[arm.ctrl].set(q_arm)
        if arm.jaw_ctrl is not None:
            ctrl = ctrl.at[arm.jaw_ctrl].set(getattr(arm.tool, jaws))
    return ctrl


def home(scene: Scene) -> jax.Array:
    """The servos' targets `[nu]` of `at_rest`."""
    return servos(scene, [arm.home for arm in scene.arms], "open")


def steps_per_s(scene: Scene) -> float:
    """Physics steps per second of our model from `at_rest`."""
    data = mujoco.MjData(scene.mj_model)
    data.qpos[:] = np.asarray(at_rest(scene).qpos)
    data.ctrl[:] = np.asarray(home(scene))
    model = scene.mj_model
    timing = _timing.time_plain(lambda: [mujoco.mj_step(model, data) for _ in range(STEPS)])
    return STEPS / timing.median_s
