"""C MuJoCo on one thread: the physics' peer."""

import _timing
import jax.numpy as jnp
import mujoco
import numpy as np

from starjax.sim import physics, scene
from starjax.sim.tasks.peg_transfer import task
from starjax.types import Pose

STEPS = 128  # a timed call


def at_rest(sim: scene.SimModel) -> physics.PhysicsState:
    """Arm at home, block standing on a peg in the middle."""
    block = Pose(jnp.eye(3), jnp.array([*sim.pegs[4], task.RIM_HEIGHT]))
    return physics.initial(sim, jnp.asarray(sim.home), block)


def steps_per_s(sim: scene.SimModel) -> float:
    """Physics steps a second of our model from `at_rest`."""
    data = mujoco.MjData(sim.mj_model)
    data.qpos[:] = np.asarray(at_rest(sim).qpos)
    data.ctrl[:] = [*sim.home, physics.JAW_OPEN]
    timing = _timing.time_plain(lambda: [mujoco.mj_step(sim.mj_model, data) for _ in range(STEPS)])
    return STEPS / timing.median_s
