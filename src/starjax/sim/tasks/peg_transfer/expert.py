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

from starjax import rcm
from starjax.sim.state import EnvState
from starjax.sim.tasks import scripting
from starjax.sim.tasks.base import CONTROL_HZ
from starjax.sim.tasks.peg_transfer import task
from starjax.types import Agent, Command, Pose

RAISE, APPROACH, DESCEND, CLOSE, LIFT, CARRY, LOWER, OPEN, RETREAT, WAIT = range(10)

# Least duration (s) and mean speed (m/s) of each phase, and jaws: +1 open, -1 closed at its end.
DURATION = (0.5, 1.2, 0.9, 0.4, 0.6, 0.9, 0.7, 0.4, 0.5, 1.0)
SPEED = (0.04, 0.04, 0.024, 1.0, 0.035, 0.038, 0.024, 1.0, 0.04, 1.0)
JAWS = (1.0, 1.0, 1.0, -1.0, -1.0, -1.0, -1.0, 1.0, 1.0, 1.0)
# Weight of the disturbance in each phase.
DISTURBANCE = (1.0, 1.0, 0.5, 0.0, 0.2, 0.6, 0.3, 0.0, 0.3, 0.0)

TEMPO = (0.85, 1.2)  # range of an episode's pace
TURN_LEAD = 0.25  # s before the end of the approach at which the tool begins to turn
TURN_TIME = 0.80  # s the turn takes

ALIGNED = 0.6  # fraction of a descent after which it goes straight down
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

NOISE_POSITION = 0.0012  # m, standard deviation of the disturbance
NOISE_ROLL = 0.07  # rad
HOVER_OUT = 0.008  # m out from the grasp point along the wall's normal
HOVER_SPREAD = 0.0015  # m, standard deviation of where it hovers


@flax.struct.dataclass
class PegScript:
    """Progress of the script in one episode.

    Attributes:
      key: of all draws, folded with the attempt or the step.
      phase: int32.
      elapsed, duration: s.
      attempt: int32, number of started grasps.
      start, goal: `[3]` m, label positions at the phase's ends.
      wall: int32, the grasped wall.
      side: -1 or 1, side of its middle.
      normal: `[3]`, the wall's direction, or the opposite: jaws are symmetric, and this keeps the
        roll on one branch.
      roll_from: rad, the roll at the start of the next turn.
      jaws_from: jaws at the phase's start.
      middle: m, y of the row with a free choice of the wall.
      tempo: pace.
      noise: `[2, 4]` disturbance of position (m) and roll (rad), rough and smooth.
      label: the undisturbed command of the one arm.
    """

    key: jax.Array
    phase: jax.Array
    elapsed: jax.Array
    duration: jax.Array
    attempt: jax.Array
    start: jax.Array
    goal: jax.Array
    wall: jax.Array
    side: jax.Array
    normal: jax.Array
    roll_from: jax.Array
    jaws_from: jax.Array
    middle: jax.Array
    tempo: jax.Array
    noise: jax.Array
    label: Command


def init(key: jax.Array, state: EnvState, middle: float = 0.0) -> PegScript:
    """Starts the script of an episode.

    `middle`: see `PegScript`; by default the pegs' middle row. Between two rows nothing is chosen.
    """
    key_tempo, key = jax.random.split(key)
    tempo = jax.random.uniform(key_tempo, minval=TEMPO[0], maxval=TEMPO[1])
    expert = PegScript(
        key=key,
        phase=jnp.asarray(RAISE, jnp.int32),
        elapsed=jnp.zeros(()),
        duration=jnp.zeros(()),
        attempt=jnp.zeros((), jnp.int32),
        start=state.pose.p[0],
        goal=state.pose.p[0],
        wall=jnp.zeros((), jnp.int32),
        side=jnp.ones(()),
        normal=jnp.array([0.0, -1.0, 0.0]),
        roll_from=jnp.zeros(()),
        jaws_from=jnp.ones(()),
        middle=jnp.asarray(middle, jnp.float32),
        tempo=tempo,
        noise=jnp.zeros((2, 4)),
        label=Command(_tip(state), jnp.ones(())),
    )
    return _enter(expert, jnp.asarray(APPROACH, jnp.int32), state, jnp.zeros(()))


def act(expert: PegScript, state: EnvState) -> tuple[Command, PegScript, Command]:
    """Returns the disturbed command to execute, the script, and the undisturbed one to record."""
    dt = 1.0 / CONTROL_HZ
    roll = _roll_of(expert, state)
    is_over = expert.elapsed >= expert.duration - 1e-6
    following = _enter(expert, _following(expert, state), state, roll)
    expert = jax.tree.map(lambda a, b: jnp.where(is_over, a, b), following, expert)
    expert = expert.replace(elapsed=expert.elapsed + dt)

    s = jnp.clip(expert.elapsed / expert.duration, 0.0, 1.0)
    # On the way down it is above its goal before anything can touch.
    is_down = (expert.phase == DESCEND) | (expert.phase == LOWER)
    aside = scripting.minimum_jerk(jnp.minimum(s / jnp.where(is_down, ALIGNED, 1.0), 1.0))
    fraction = jnp.stack([aside, aside, scripting.minimum_jerk(s)])
    p = expert.start + fraction * (expert.goal - expert.start)
    expert = expert.replace(label=Command(expert.label.pose._replace(p=p), expert.label.gripper))
    roll = _roll_of(expert, state)
    target = jnp.asarray(JAWS)[expert.phase]
    gripper = scripting.jaws(expert.jaws_from, target, expert.elapsed)

    weight = jnp.asarray(DISTURBANCE)[expert.phase]
    deviation = jnp.array([NOISE_POSITION] * 3 + [NOISE_ROLL])
    noise = scripting.disturb(expert.key, expert.noise, state.step, deviation)
    moved = weight * noise[1] * jnp.where(expert.phase == DESCEND, 1.0 - s, 1.0)
    decode = rcm.ACTION_SPACES["rcm4"].decode
    clean, _ = decode(jnp.append(roll, p), _told(state))
    rough, _ = decode(jnp.append(roll + moved[3], p + moved[:3]), _told(state))
    expert = expert.replace(noise=noise, label=Command(clean, gripper))
    return _of_one_arm(rough, gripper), expert, _of_one_arm(clean, gripper)


def _of_one_arm(pose: Pose, gripper: jax.Array) -> Command:
    return jax.tree.map(lambda leaf: leaf[None], Command(pose, gripper))


def _told(state: EnvState) -> rcm.TrocarFrame:
    return jax.tree.map(lambda leaf: leaf[0], state.measured_trocar)


def _tip(state: EnvState) -> Pose:
    return jax.tree.map(lambda leaf: leaf[0], state.pose)


def _following(expert: PegScript, state: EnvState) -> jax.Array:
    """Returns the next phase, the first one if the block is not held."""
    phase = expert.phase
    grasped = (
        state.measurements.block.p
        + task.RIM_RADIUS * task.wall_normals(state.measurements.block)[expert.wall]
    )
    is_held = jnp.sum((grasped - state.pose.p[0]) ** 2) < HELD**2
    is_lost = (phase >= LIFT) & (phase <= CARRY) & ~is_held
    return jnp.where(is_lost | (phase == WAIT), RAISE, phase + 1).astype(jnp.int32)


def _enter(expert: PegScript, phase: jax.Array, state: EnvState, roll: jax.Array) -> PegScript:
    """Begins `phase`: choose the wall if it is an approach, set goal and duration."""
    block, tip = state.measurements.block, expert.label.pose.p
    is_approach = phase == APPROACH
    attempt = expert.attempt + is_approach
    keys = jax.random.split(jax.random.fold_in(expert.key, attempt), 3)
    key_wall, key_side, key_hover = keys
    normals = task.wall_normals(block)
    # The jaws' axis stays within 60 degrees of the world's y: the roll then never meets its wrap.
    skew = jnp.abs(normals[:, 0])
    is_candidate = skew <= jnp.sort(skew)[CANDIDATES - 1]
    # The candidate towards the board's middle is preferred: its shaft leans away from the peg.
    # On the middle row it is the one that needs less roll, or either if they are equivalent.
    unlike = normals[:, 1] * (block.p[1] - expert.middle) / OUTWARD + skew / SKEW
    chosen = jax.random.categorical(key_wall, jnp.where(is_candidate, -unlike, -jnp.inf))
    wall = jnp.where(is_approach, chosen, expert.wall)
    out = normals[wall] * jnp.array([1.0, 1.0, 0.0])
    out = out / jnp.maximum(jnp.linalg.norm(out), 1e-6)
    normal = jnp.where(phase <= DESCEND, out * jnp.where(out[1] > 0, -1.0, 1.0), expert.normal)

    side = jnp.where(is_approach, jax.random.rademacher(key_side, (), jnp.float32), expert.side)
    tangent = jnp.cross(block.R[:, 2], normals[wall])
    grasp = block.p + task.RIM_RADIUS * normals[wall] + side * GRASP_SIDE * tangent
    grasp = grasp - jnp.array([0.0, 0.0, GRASP_DROP])
    spread = HOVER_SPREAD * jax.random.normal(key_hover, (3,)) * jnp.array([1.0, 1.0, 0.5])
    hover = task.RIM_HEIGHT - GRASP_DROP + HOVER
    # The tip's position once the block, tilted by now, is upright over the target peg: on its wall,
    # as far along it as the grasp is.
    along = jnp.array([-out[1], out[0]])
    aside = ((state.pose.p[0] - block.p)[:2] @ along) * along
    over = state.layout.target_peg + (task.RIM_RADIUS + RELEASE_SHIFT) * out[:2] + aside
    low = task.RIM_HEIGHT - GRASP_DROP + RELEASE_HEIGHT
    goals = jnp.stack(
        [
            tip.at[2].set(jnp.maximum(tip[2], hover)),
            grasp.at[2].set(hover) + HOVER_OUT * out + spread,
            grasp,
            tip,
            tip.at[2].set(hover),
            jnp.append(over, hover),
            jnp.append(over, low),
            tip,
            tip.at[2].set(tip[2] + HOVER),
            tip,
        ]
    )
    goal = goals[phase]
    duration = jnp.maximum(
        jnp.asarray(DURATION)[phase], jnp.linalg.norm(goal - tip) / jnp.asarray(SPEED)[phase]
    )
    return expert.replace(
        phase=phase,
        elapsed=jnp.zeros(()),
        duration=duration / expert.tempo,
        attempt=attempt,
        start=tip,
        goal=goal,
        wall=wall,
        side=side,
        normal=normal,
        roll_from=jnp.where(phase <= APPROACH, roll, expert.roll_from),
        jaws_from=expert.label.gripper,
    )


def _roll_of(expert: PegScript, state: EnvState) -> jax.Array:
    """Returns the roll (rad) at the label's position, turning towards the wall's normal."""
    pose, _ = rcm.ACTION_SPACES["rcm4"].decode(jnp.append(0.0, expert.label.pose.p), _told(state))
    on_wall = jnp.arctan2(-expert.normal @ pose.R[:, 0], expert.normal @ pose.R[:, 1])
    lead = TURN_LEAD + jnp.where(
        expert.phase == APPROACH, expert.elapsed - expert.duration, expert.elapsed
    )
    turned = jnp.clip(lead * expert.tempo / TURN_TIME, 0.0, 1.0)
    turned = jnp.where(expert.phase > DESCEND, 1.0, jnp.where(expert.phase == RAISE, 0.0, turned))
    weight = 0.5 - 0.5 * jnp.cos(jnp.pi * turned)
    return expert.roll_from + weight * (on_wall - expert.roll_from)


AGENT = Agent(init, act)
# On the middle row it always takes the wall of one side.
WITH_ONE_WALL = Agent(functools.partial(init, middle=BETWEEN_ROWS), act)
