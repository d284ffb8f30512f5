"""Scripted expert of peg transfer: a phase machine on the block's pose.

It draws a side of the wall's middle, one of two equivalent walls (never by the trocar) and a pace,
is disturbed on purpose, and starts over if the block is misplaced.
The roll follows from tip positions and trocar alone: the tool turns only once the coming positions
include the grasp point, and the jaws' axis then stays on the wall's normal. It comes in along that
normal, from outside: the path determines the wall, and paths to two walls differ.
"""

import functools

import flax.struct
import jax
import jax.numpy as jnp

from starjax.sim.state import EnvState
from starjax.tasks import phases
from starjax.tasks.peg_transfer import task
from starjax.tasks.phases import APPROACH, DESCEND, RAISE, TURN_LEAD

CLOSE, LIFT, CARRY, LOWER, OPEN, RETREAT, WAIT = range(3, 10)
TIMING = phases.PhaseTable(
    duration=(0.5, 1.2, 0.9, 0.0, 0.6, 0.9, 0.7, 0.0, 0.5, 1.0),
    speed=(0.04, 0.04, 0.024, 1.0, 0.035, 0.038, 0.024, 1.0, 0.04, 1.0),
    jaws=(1.0, 1.0, 1.0, -1.0, -1.0, -1.0, -1.0, 1.0, 1.0, 1.0),
    tempo=(0.85, 1.2),
)
HOVER = 0.026  # m above the grasp point
GRASP_DROP = 0.001  # m below the rim's centre line
RELEASE_HEIGHT = 0.0007  # m above the grasp's height, of the release
RELEASE_SHIFT = 0.0005  # m further out along the grasped wall's normal: room for the inner pad
HELD = 0.006  # m from the tip within which the grasped wall counts as held
GRASP_SIDE = 0.0015  # m along the wall, to either side of its middle
CANDIDATES = 2  # walls to choose from
OUTWARD = 0.001  # m off the middle row at which a preference shows
BETWEEN_ROWS = 0.012  # m off the middle row, half way to the next
SKEW = 0.1  # sine of the angle between jaws and the world's y at which a preference shows
HOVER_OUT = 0.008  # m out from the grasp point along the wall's normal
HOVER_SPREAD = 0.0015  # m, standard deviation of where it hovers


@flax.struct.dataclass
class PegScript(phases.GraspScript):
    """Progress of the script in one episode.

    Attributes:
      wall: int32, the grasped wall.
      side: -1 or 1, side of its middle.
      middle: m, y of the row with a free choice of the wall.
    """

    wall: jax.Array
    side: jax.Array
    middle: jax.Array


def init(key: jax.Array, state: EnvState, middle: float = 0.0) -> PegScript:
    """Starts the script of an episode.

    `middle`: see `PegScript`; by default the pegs' middle row. Between two rows nothing is chosen.
    """
    own = {"wall": jnp.zeros((), jnp.int32), "side": jnp.ones(())}
    own |= phases.grasp_fields() | {"middle": jnp.asarray(middle, jnp.float32)}
    script = phases.begin(PegScript, TIMING, key, state.pose.p[0], **own)
    return _enter(script, jnp.asarray(APPROACH, jnp.int32), state)


def _following(script: PegScript, state: EnvState) -> jax.Array:
    """Returns the next phase, the first one if the block is not held, or not on its peg."""
    phase, block = script.phase, state.measurements.block
    grasped = block.p + task.RIM_RADIUS * task.wall_normals(block)[script.wall]
    # By place: jaws also touch a block that they have just let slip.
    is_held = jnp.sum((grasped - state.pose.p[0]) ** 2) < HELD**2
    is_lost = (phase >= LIFT) & (phase <= CARRY) & ~is_held
    # Only after the release is it seen if the block has come down on its peg.
    is_off = (phase == RETREAT) & ~task.is_threaded(block, state.layout.target_peg)
    again = is_lost | is_off | (phase == WAIT)
    return jnp.where(again, RAISE, phase + 1).astype(jnp.int32)


def _enter(script: PegScript, phase: jax.Array, state: EnvState) -> PegScript:
    """Begins `phase`: chooses the wall if it is an approach, sets goal and duration."""
    block, tip = state.measurements.block, script.at
    is_approach = phase == APPROACH
    attempt = script.attempt + is_approach
    keys = jax.random.split(jax.random.fold_in(script.key, attempt), 3)
    key_wall, key_side, key_hover = keys
    normals = task.wall_normals(block)
    # The jaws' axis stays within 60 degrees of the world's y: the roll then never meets its wrap.
    skew = jnp.abs(normals[:, 0])
    is_candidate = skew <= jnp.sort(skew)[CANDIDATES - 1]  # normals with the smallest |x|
    # The candidate towards the board's middle is preferred: its shaft leans away from the peg.
    # On the middle row it is the one that needs less roll, or either if they are equivalent.
    unlike = normals[:, 1] * (block.p[1] - script.middle) / OUTWARD + skew / SKEW
    chosen = jax.random.categorical(key_wall, jnp.where(is_candidate, -unlike, -jnp.inf))
    wall = jnp.where(is_approach, chosen, script.wall)
    out = phases.horizontal(normals[wall])  # the block may be tilted
    # Left or right of the wall's middle: two modes of the demonstrations.
    side = jnp.where(is_approach, jax.random.rademacher(key_side, (), jnp.float32), script.side)
    tangent = jnp.cross(block.R[:, 2], normals[wall])
    grasp = block.p + task.RIM_RADIUS * normals[wall] + side * GRASP_SIDE * tangent
    grasp = grasp - jnp.array([0.0, 0.0, GRASP_DROP])
    # Approaches of many places, as a policy's will be
    spread = HOVER_SPREAD * jax.random.normal(key_hover, (3,)) * jnp.array([1.0, 1.0, 0.5])
    hover = task.RIM_HEIGHT - GRASP_DROP + HOVER
    # The tip's position once the block, tilted by now, is upright over the target peg: on its wall,
    # as far along it as the grasp is.
    along = jnp.array([-out[1], out[0]])
    aside = ((state.pose.p[0] - block.p)[:2] @ along) * along
    over = state.layout.target_peg + (task.RIM_RADIUS + RELEASE_SHIFT) * out[:2] + aside
    low = task.RIM_HEIGHT - GRASP_DROP + RELEASE_HEIGHT
    goals = [
        tip.at[2].set(jnp.maximum(tip[2], hover)),  # RAISE
        grasp.at[2].set(hover) + HOVER_OUT * out + spread,  # APPROACH
        grasp,
        tip,
        tip.at[2].set(hover),  # LIFT
        jnp.append(over, hover),  # CARRY
        jnp.append(over, low),  # LOWER
        tip,
        tip.at[2].set(tip[2] + HOVER),  # RETREAT
        tip.at[2].add(phases.RISE),  # WAIT
    ]
    return phases.enter(
        script,
        TIMING,
        phase,
        goals,
        attempt=attempt,
        wall=wall,
        side=side,
        # The block turns with the jaws
        normal=jnp.where(phase <= DESCEND, phases.towards_arm(out), script.normal),
        roll_from=jnp.where(phase <= APPROACH, script.roll, script.roll_from),
    )


def _lead(script: PegScript) -> jax.Array:
    since = script.elapsed - script.duration
    return TURN_LEAD + jnp.where(script.phase == APPROACH, since, script.elapsed)


GRASP = phases.Grasp(
    timing=TIMING,
    disturbance=(1.0, 1.0, 0.5, 0.0, 0.2, 0.6, 0.3, 0.0, 0.3, 0.0),
    deviation=(0.0012, 0.0012, 0.0012, 0.07),
    straight=(DESCEND, LOWER),
    following=_following,
    enter=_enter,
    lead=_lead,
    starts_at_label=True,
)
AGENT = phases.agent(init, GRASP)
# On the middle row it always takes the wall of one side.
WITH_ONE_WALL = phases.agent(functools.partial(init, middle=BETWEEN_ROWS), GRASP)
