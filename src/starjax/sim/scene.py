"""Composes robot, tool and task into one MuJoCo model and resolves every id once.

A second robot or tool is one more MJCF file with the sites and names of the others: a task offers
`robot_base`, a robot ends in `flange`, a tool brings `tcp` (`mjcf/README.md` has the rest). In the
composed model the robot's names begin with `robot/`, the tool's with `robot/tool/`.
"""

from typing import NamedTuple

import mujoco
import numpy as np

from starjax.sim import assets, ik, solver
from starjax.sim.camera import geometry
from starjax.sim.engine import mjx

# Which MJCF parts exist. Adding one: a file and a line.
ROBOTS = {"fr5": "arms/fr5/fr5.xml"}
TOOLS = {"grasper": "tools/grasper/grasper.xml"}
TASKS = {"peg_transfer": "tasks/peg_transfer/peg_transfer.xml"}

# The grasper turned on the flange so that j6 stays far from its limits over all trocars (rad).
TOOL_MOUNT = -1.75
# Arm configuration above the board's centre, port nominal (rad); IK starts from here.
HOME = (-0.18, -1.10, 1.90, -2.36, -1.571, 0.0)


TCP = "robot/tool/tcp"  # site of the tip, {E}


class SimModel(NamedTuple):
    """What never varies in an environment.

    Attributes:
      mj_model: the C model; `mjx_model`: its MJX copy; `mjx_data`: a template of the state.
      arm: kinematic chain from the world to the tcp, see `ik.Chain`.
      home: `[6]` rad, where inverse kinematics starts.
      p_world_ref: `[3]` m, the nominal port o_ref.
      arm_q, jaw, block: where the arm's, the jaws' and the block's coordinates start in qpos;
        `arm_dof`, `block_dof`: in qvel.
      geom_rgb: `[G, 3]` colours; peg_geoms, seat_geoms: `[P]` geom ids; pad_geoms, wall_geoms.
      pegs: `[P, 2]` m, the pegs' axes on the board.
    """

    mj_model: mujoco.MjModel
    mjx_model: mjx.Model
    mjx_data: mjx.Data
    arm: ik.Chain
    home: np.ndarray
    p_world_ref: np.ndarray
    arm_q: int
    arm_dof: int
    jaw: int
    block: int
    block_dof: int
    geom_rgb: np.ndarray
    peg_geoms: np.ndarray
    seat_geoms: np.ndarray
    pad_geoms: np.ndarray
    wall_geoms: np.ndarray
    pegs: np.ndarray


def compose(
    robot: str = "fr5", tool: str = "grasper", task: str = "peg_transfer"
) -> mujoco.MjModel:
    """The C model of `robot` holding `tool` in `task`; ValueError for an unknown name."""
    for kind, name, known in (
        ("robot", robot, ROBOTS),
        ("tool", tool, TOOLS),
        ("task", task, TASKS),
    ):
        if name not in known:
            raise ValueError(f"{kind}: expected one of {sorted(known)}, got {name!r}")
    geometry = mujoco.MjSpec.from_file(str(assets.path(TASKS[task])))
    arm = mujoco.MjSpec.from_file(str(assets.path(ROBOTS[robot])))
    hand = mujoco.MjSpec.from_file(str(assets.path(TOOLS[tool])))
    flange = arm.site("flange")
    flange.quat = [np.cos(TOOL_MOUNT / 2), 0.0, 0.0, np.sin(TOOL_MOUNT / 2)]
    arm.attach(hand, site=flange, prefix="tool/")
    geometry.attach(arm, site=geometry.site("robot_base"), prefix="robot/")
    return geometry.compile()


def load(robot: str = "fr5", tool: str = "grasper", task: str = "peg_transfer") -> SimModel:
    """`compose`d, copied to MJX, ids resolved."""
    m = compose(robot, tool, task)
    # XLA's MJX implementation everywhere: the warp one needs CUDA.
    mjx_model = mjx.put_model(m, impl="jax")
    mjx_data = mjx.make_data(m, impl="jax")
    solver.check(mjx_model, mjx_data)
    numbered = sum(m.geom(g).name.startswith("peg") for g in range(m.ngeom))
    peg_geoms = np.array([m.geom(f"peg{i}").id for i in range(numbered)])
    return SimModel(
        mj_model=m,
        mjx_model=mjx_model,
        mjx_data=mjx_data,
        arm=ik.chain_of(m, first="robot/shoulder", site=TCP),
        home=np.array(HOME, np.float32),
        p_world_ref=np.array(m.site("port_reference").pos, np.float32),
        arm_q=int(m.joint("robot/j1").qposadr[0]),
        jaw=int(m.joint("robot/tool/jaw_left").qposadr[0]),
        arm_dof=int(m.joint("robot/j1").dofadr[0]),
        block=int(m.joint("block").qposadr[0]),
        block_dof=int(m.joint("block").dofadr[0]),
        geom_rgb=geometry.geom_rgb(m),
        peg_geoms=peg_geoms,
        seat_geoms=np.array([m.geom(f"seat{i}").id for i in range(numbered)]),
        pad_geoms=np.array([m.geom(f"robot/tool/pad_{side}").id for side in ("left", "right")]),
        wall_geoms=np.array([m.geom(f"wall{i}").id for i in range(3)]),
        pegs=np.array(m.geom_pos[peg_geoms, :2], np.float32),
    )
