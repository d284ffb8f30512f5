"""MJX under the environment: what is carried between steps, and one control period of it."""

import flax.struct
import jax
import jax.numpy as jnp

from starjax.sim import solver
from starjax.sim.engine import mjx
from starjax.sim.scene import SimModel
from starjax.types import Pose

# Jaw targets at gripper -1 and +1 (m a side): past closed, so that the servo squeezes.
JAW_CLOSED = -0.001
JAW_OPEN = 0.0032
# Natural frequency of the joint servos (rad/s), as in fr5.xml.
SERVO_FREQUENCY = 100.0
# Beyond these the solver has diverged.
MAX_ARM_SPEED = 20.0  # rad/s
MAX_BLOCK_SPEED = 5.0  # m/s
MAX_BLOCK_DISTANCE = 1.0  # m from the board's centre

TARGET_RGB = (0.98, 0.62, 0.1)


@flax.struct.dataclass
class PhysicsState:
    """All of `mjx.Data` that the next step needs.

    Attributes:
      qpos: `[15]`: block (7), arm (6) rad, jaws (2) m. qvel: `[14]`. qacc_warmstart: `[14]`.
    """

    qpos: jax.Array
    qvel: jax.Array
    qacc_warmstart: jax.Array


def initial(sim: SimModel, q: jax.Array, block: Pose) -> PhysicsState:
    """At rest: arm at `q` `[6]` rad, jaws open, block upright at `block`."""
    half = 0.5 * jnp.arctan2(block.R[1, 0], block.R[0, 0])
    zero = jnp.zeros(())
    quat = jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)])
    qpos = jnp.zeros(sim.mj_model.nq)
    qpos = qpos.at[sim.block : sim.block + 7].set(jnp.concatenate([block.p, quat]))
    qpos = qpos.at[sim.arm_q : sim.arm_q + 6].set(q)
    qpos = qpos.at[sim.jaw : sim.jaw + 2].set(JAW_OPEN)
    still = jnp.zeros(sim.mj_model.nv)
    return PhysicsState(qpos=qpos, qvel=still, qacc_warmstart=still)


def advance(
    sim: SimModel,
    state: PhysicsState,
    q: jax.Array,
    dq: jax.Array,
    velocity: jax.Array,
    gripper: jax.Array,
    period: float,
) -> tuple[PhysicsState, jax.Array, jax.Array]:
    """One control period: the joint target moves smoothly from `q` to `q + dq`.

    The target follows the cubic that begins at `velocity` and ends at `dq / period`; velocity and
    acceleration are fed forward, or each change of speed would swing the long tool off its port.

    Args:
      q, dq: `[6]` rad. velocity: `[6]` rad/s, of the target before. gripper: `[]` in [-1, 1].
      period: s.

    Returns:
      the state after; whether a pad touches a wall of the block in the last substep; the arm's
      joints where each substep began, `[substeps, 6]` rad.
    """
    substeps = round(period / sim.mj_model.opt.timestep)
    jaw = JAW_CLOSED + 0.5 * (gripper + 1.0) * (JAW_OPEN - JAW_CLOSED)
    turn = period * velocity - dq

    def substep(i, carry):
        state, _, passed = carry
        passed = passed.at[i].set(state.qpos[sim.arm_q : sim.arm_q + 6])
        s = (i + 1) / substeps
        # Cubic Hermite: the straight line, and the bend that its first slope asks for.
        x = q + s * dq + s * (1 - s) ** 2 * turn
        v = (dq + (1 - s) * (1 - 3 * s) * turn) / period
        a = (6 * s - 4) * turn / period**2
        target = x + 2.0 / SERVO_FREQUENCY * v + a / SERVO_FREQUENCY**2
        data = sim.mjx_data.replace(
            qpos=state.qpos,
            qvel=state.qvel,
            qacc_warmstart=state.qacc_warmstart,
            ctrl=jnp.append(target, jaw),
        )
        data = solver.step(sim.mjx_model, data)
        state = PhysicsState(data.qpos, data.qvel, data.qacc_warmstart)
        return state, _jaw_contact(sim, data), passed

    first = state, jnp.zeros((), bool), jnp.zeros((substeps, 6))
    return jax.lax.fori_loop(0, substeps, substep, first)


def is_sound(sim: SimModel, state: PhysicsState) -> jax.Array:
    """False once the simulation has diverged: not finite, or faster than anything physical."""
    finite = jax.tree.reduce(lambda ok, x: ok & jnp.all(jnp.isfinite(x)), state, jnp.ones((), bool))
    arm = jnp.max(jnp.abs(state.qvel[sim.arm_dof : sim.arm_dof + 6]))
    block = jnp.max(jnp.abs(state.qvel[sim.block_dof : sim.block_dof + 3]))
    away = jnp.max(jnp.abs(state.qpos[sim.block : sim.block + 3]))
    return finite & (arm < MAX_ARM_SPEED) & (block < MAX_BLOCK_SPEED) & (away < MAX_BLOCK_DISTANCE)


def block_pose(sim: SimModel, state: PhysicsState) -> Pose:
    """pose_world_block."""
    coords = state.qpos[sim.block : sim.block + 7]
    w, x, y, z = coords[3:] / jnp.linalg.norm(coords[3:])
    rows = (
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    )
    return Pose(jnp.stack([jnp.stack(row) for row in rows]), coords[:3])


def opening(sim: SimModel, state: PhysicsState) -> jax.Array:
    """Measured opening of the jaws in [-1, 1]: -1 closed on nothing, +1 fully open."""
    return jnp.clip(2.0 * state.qpos[sim.jaw] / JAW_OPEN - 1.0, -1.0, 1.0)


def geom_poses(sim: SimModel, qpos: jax.Array, port: jax.Array) -> tuple[jax.Array, jax.Array]:
    """`[G, 3]` m and `[G, 3, 3]` of every geom, the port's marker at `port` `[3]` m."""
    data = sim.mjx_data.replace(qpos=qpos, mocap_pos=port[None])
    data = mjx.kinematics(sim.mjx_model, data)
    return data.geom_xpos, data.geom_xmat


def colours(sim: SimModel, target: jax.Array) -> jax.Array:
    """`[G, 3]` in [0, 1]: the model's colours, with the target peg and its seat marked."""
    rgb = jnp.asarray(sim.geom_rgb)
    marked = jnp.stack([jnp.asarray(sim.peg_geoms)[target], jnp.asarray(sim.seat_geoms)[target]])
    return rgb.at[marked].set(jnp.array(TARGET_RGB))


def _jaw_contact(sim: SimModel, data: mjx.Data) -> jax.Array:
    contact = data._impl.contact
    geom = contact.geom
    pad = _any_of(geom, sim.pad_geoms)
    wall = _any_of(geom, sim.wall_geoms)
    return jnp.any((contact.dist < 0) & jnp.any(pad, axis=-1) & jnp.any(wall, axis=-1))


def _any_of(geom: jax.Array, ids) -> jax.Array:
    return jnp.any(jnp.asarray(geom)[..., None] == jnp.asarray(ids), axis=-1)
