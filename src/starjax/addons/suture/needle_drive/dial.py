"""Needle drive along the dial: bites whose needle turns by 84 to 150 degrees, in a chosen plane.

The needle's arc passes both marks in any plane through them: the plane's lean is free. One lean
serves all trocars up to a turn of 117 degrees; from 133 on none does, and the expert's lean suits
the trocar. A second expert keeps one lean. The jaws hold the wire level with the arc's centre when
the point leaves, as in `experiments/wrist/dial/bites.py`.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.addons.suture.needle_drive import expert, grasps, task
from starjax.addons.suture.tissue import needle as needles
from starjax.addons.suture.tissue.needle import Bite
from starjax.core.types import Pose
from starjax.sim.state import EnvState
from starjax.sim.tools import needle_driver
from starjax.tasks.wrist_script import WRIST, tip_of

SIZE, TOOL = needles.SH, needle_driver.TOOL
AROUND = expert.BEFORE + expert.EMERGE / SIZE.radius  # rad, turned before and after the bite
TURNS = (float(np.deg2rad(84.0)), float(np.deg2rad(150.0)))  # rad
SHORTEST, LONGEST = (
    2.0 * SIZE.radius * float(np.sin(0.5 * (turn - AROUND))) for turn in TURNS
)  # m
BINS = 6  # bins of the turn, the label of an episode

# Found by a search for one lean of the plane at every trocar up to the largest turn.
GRASP_TURN, GRASP_LEAN = float(np.deg2rad(135.0)), float(np.deg2rad(50.0))
LEAN = float(np.deg2rad(-15.0))  # rad of the plane, if it serves
LEANS = np.deg2rad(np.arange(-40.0, 41.0, 5.0)).astype(np.float32)
ENOUGH = float(np.deg2rad(4.0))  # rad, from the wrist's limits
STEPS = 16  # along the arc


def turn_of(bite: Bite) -> jax.Array:
    """Returns the needle's whole turn (rad)."""
    return 2.0 * needles.entry_angle(SIZE, bite) + AROUND


def label(layout: task.DriveLayout) -> dict[str, jax.Array]:
    """Returns the bin of the turn."""
    share = (turn_of(layout.bite) - TURNS[0]) / (TURNS[1] - TURNS[0])
    return {"turn": jnp.clip(jnp.floor(BINS * share), 0, BINS - 1).astype(jnp.int32)}


def grasp(bite: Bite) -> Pose:
    """Returns pose_tip_needle, the jaws as far before the arc's middle as the bite is wide."""
    first, angle = grasps.grasp(SIZE, 0.0, GRASP_TURN, GRASP_LEAN), -needles.entry_angle(SIZE, bite)
    R = first.R @ rcm.rotation_z(-angle)
    return Pose(R, -R @ needles.offset_at(SIZE, angle))


def up_of(bite: Bite, lean: jax.Array) -> jax.Array:
    """Returns the unit vector `[3]` up in the arc's plane, which leans by `lean` rad."""
    along = (bite.exit - bite.entry) / jnp.linalg.norm(bite.exit - bite.entry)
    up = jnp.array(needles.VERTICAL)
    return jnp.cos(lean) * up + jnp.sin(lean) * jnp.cross(up, along)


def margin(bite: Bite, p_trocar: jax.Array, lean: jax.Array) -> jax.Array:
    """Returns the least distance (rad) to the wrist's limits on the arc, -1 if a part is low."""
    half, up, held = needles.entry_angle(SIZE, bite), up_of(bite, lean), grasp(bite)
    end = half + expert.EMERGE / SIZE.radius
    turns = jnp.linspace(-half - expert.BEFORE, end, STEPS)
    tip = jax.vmap(lambda turn: tip_of(needles.pose_on(SIZE, bite, turn, up), held))(turns)
    angles = rcm.angles_through(WRIST, tip, p_trocar)
    limits = jnp.array([WRIST.pitch, WRIST.yaw])
    palm = tip.p[:, 2] - WRIST.jaws * tip.R[:, 2, 2]
    shaft = rcm.shaft_of(WRIST, tip, angles).p[:, 2]
    is_clear = (palm >= TOOL.palm_radius).all() & (shaft >= TOOL.shaft_radius).all()
    return jnp.where(is_clear, jnp.min(limits - jnp.abs(angles)), -1.0)


def plane(state: EnvState) -> jax.Array:
    """Returns the direction up in the plane: `LEAN` if it serves, else the nearest that does."""
    bite, p_trocar = state.layout.bite, state.measured_trocar.p_world_trocar[0]
    found = jax.vmap(functools.partial(margin, bite, p_trocar))(jnp.asarray(LEANS))
    # Enough margin first, then little change: a degree off LEAN costs less than any lack of margin.
    score = jnp.minimum(found, ENOUGH) - 1e-3 * jnp.abs(LEANS - LEAN)
    return up_of(bite, jnp.asarray(LEANS)[jnp.argmax(score)])


def one_plane(state: EnvState) -> jax.Array:
    """Returns the direction up in the plane that every trocar gets."""
    return up_of(state.layout.bite, jnp.asarray(LEAN))


AGENT, ONE_PLANE = expert.agent(SIZE, plane), expert.agent(SIZE, one_plane)
HERE = "starjax.addons.suture.needle_drive.dial"
TASK = task.make(
    "needle_drive_dial",
    SIZE,
    (SHORTEST, LONGEST),
    {"default": f"{HERE}:AGENT", "one_plane": f"{HERE}:ONE_PLANE"},
    lambda bound, bite: grasp(bite),
    labels=("turn",),
    label=label,
)
