"""Scripted expert of suture throw: pick, drive, let go, take the point, turn out, pull.

It commands tip poses: straight ways between them, and the needle's path of the bite while the
needle is in the pad. The point is taken twice, since no grasp turns the needle out at once with
room for the wrist; both grasps are the same at every trocar, see `far_grasp`.

The script is disturbed on purpose while the pad holds nothing, and it closes the jaws a little off
each grasp: a policy learns from it to carry on with a needle that lies otherwise in the jaws. Its
ways end with a short slope, since a policy can stay where demonstrations wait.
"""

import flax.struct
import jax
import jax.numpy as jnp

from starjax.addons.suture.needle_drive import grasps
from starjax.addons.suture.suture_throw import far_grasp, task
from starjax.addons.suture.tissue import needle as needles
from starjax.core.types import Agent, Command, Pose
from starjax.sim.state import EnvState
from starjax.tasks import phases, scripting, wrist_script
from starjax.tasks.wrist_script import tip_of

(
    APPROACH, DESCEND, CLOSE, LIFT, OVER, DOWN, DRIVE, OPEN, BACK, AROUND, REACH, TAKE, OUT, PULL,
    HOLD,
) = range(15)  # fmt: skip
TIMING = phases.PhaseTable(
    duration=(1.2, 0.8, 0.0, 0.8, 1.8, 1.0, 0.0, 0.0, 0.6, 2.5, 0.9, 0.0, 0.0, 1.5, 1.0),
    speed=(0.03, 0.02, 1.0, 0.02, 0.03, 0.02, 1.0, 1.0, 0.02, 0.02, 0.02, 1.0, 1.0, 0.03, 1.0),
    jaws=(1.0, 1.0, -1.0, -1.0, -1.0, -1.0, -1.0, 1.0, 1.0, 1.0, 1.0, -1.0, -1.0, -1.0, -1.0),
    tempo=(0.9, 1.2),
)
DISTURBANCE = (1.0, 1.0, 0.0, 0.3, 1.0, 0.5, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.3, 0.1)
SETTLES = (DESCEND, DOWN, REACH)  # phases whose disturbance fades
# The jaws close off a grasp by at most so much along (m) and about (rad) each axis of the tip.
MISS = (0.0005, 0.0005, 0.0005, 0.035, 0.035, 0.035)
MISS_STREAM = 1 << 21  # folded into the key: distinct from every other stream
HOVER = 0.015  # m above a grasp, along the jaws, and above the start of the arc
LIFT_HEIGHT = 0.02  # m
BEFORE = 0.17  # rad on the arc to the entry
EMERGE = 0.006  # m of wire past the exit, to be taken
OUT_ENOUGH = 0.8 * EMERGE
MIDDLE = 0.55  # part of the turn out of the pad, where the point is taken again
PAST = 0.35  # rad that the needle turns on behind the exit
TURN_SPEED = 0.4  # rad/s on the arc, the mean
END = (0.0, 0.0, 0.088)  # m, of the tip


@flax.struct.dataclass
class ThrowScript(wrist_script.WristScript):
    """Progress of the script in one episode.

    Attributes:
      turn, turn_end: rad, the needle's on the path at the phase's ends.
      held: pose_tip_needle at the phase's start.
      leg: int32, number of the present one.
      miss: `[6]` m and rad, in the tip's frame, off the present grasp.
    """

    turn: jax.Array
    turn_end: jax.Array
    held: Pose
    leg: jax.Array
    miss: jax.Array


def init(key: jax.Array, state: EnvState) -> ThrowScript:
    """Starts the script of an episode."""
    zero, first = jnp.zeros(()), jnp.zeros((), jnp.int32)
    own = {"turn": zero, "turn_end": zero, "held": held(state), "leg": first, "miss": jnp.zeros(6)}
    own |= wrist_script.rotations(state.pose.R[0])
    script = phases.begin(ThrowScript, TIMING, key, state.pose.p[0], **own)
    return enter(script, jnp.asarray(APPROACH, jnp.int32), state)


def turns(bite: needles.Bite) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Returns turns (rad) of the needle: its point is taken, taken again, and its tail is out."""
    half = needles.entry_angle(task.SIZE, bite)
    out, end = half + EMERGE / task.SIZE.radius, half + task.SIZE.sweep
    return out, out + MIDDLE * (end - out), end


def held(state: EnvState) -> Pose:
    """Returns pose_tip_needle as measured."""
    return wrist_script.held(state, state.measurements.drive.needle)


def enter(script: ThrowScript, phase: jax.Array, state: EnvState) -> ThrowScript:
    """Begins `phase`: sets its goal, rotation and duration."""
    bite, grip, needle = state.layout.bite, held(state), state.measurements.drive.needle
    out, middle, end = turns(bite)
    # From the middle on, the grasp is let go for the second.
    again = (phase == OPEN) & (script.phase == OUT)
    leg = jnp.where(again, 1, script.leg).astype(jnp.int32)
    half = needles.entry_angle(task.SIZE, bite)
    # The next way begins at the pose in which the jaws have closed.
    closed = (script.phase == CLOSE) | (script.phase == TAKE)
    at = wrist_script.off(Pose(script.R, script.at), closed * script.miss)
    script = script.replace(R=at.R, at=at.p)
    first = tip_of(needle, grasps.grasp(task.SIZE))
    start = tip_of(needles.pose_on(task.SIZE, bite, -half - BEFORE), grip)
    far = tip_of(needle, jax.tree.map(lambda leaf: leaf[leg], far_grasp.grasps(task.SIZE)))
    up = jnp.array([0.0, 0.0, 1.0])
    stays = Pose(script.R, script.at)
    goals = {
        APPROACH: Pose(first.R, first.p - HOVER * first.R[:, 2]),
        DESCEND: first,
        LIFT: Pose(stays.R, stays.p + LIFT_HEIGHT * up),
        OVER: Pose(start.R, start.p + HOVER * up),
        DOWN: start,
        BACK: Pose(stays.R, stays.p - HOVER * stays.R[:, 2]),
        AROUND: Pose(far.R, far.p - HOVER * far.R[:, 2]),
        REACH: far,
        PULL: Pose(stays.R, jnp.array(END)),
    }
    chosen = [goals.get(number, stays) for number in range(HOLD + 1)]
    turn = needles.turn_on(task.SIZE, bite, needle)
    turn = jnp.where(phase == OUT, task.turn_out(turn), turn)
    script = wrist_script.enter(
        script,
        TIMING,
        phase,
        [goal.p for goal in chosen],
        jnp.stack([goal.R for goal in chosen])[phase],
        turn=turn,
        turn_end=jnp.where(phase == OUT, jnp.where(leg == 0, middle, end + PAST), out),
        held=grip,
        leg=leg,
        miss=_drawn_miss(script, phase, state),
    )
    sweep = jnp.abs(script.turn_end - turn) / TURN_SPEED / script.tempo
    is_arc = (phase == DRIVE) | (phase == OUT)
    return script.replace(duration=jnp.where(is_arc, sweep, script.duration))


def _drawn_miss(script: ThrowScript, phase: jax.Array, state: EnvState) -> jax.Array:
    """Returns `[6]`: a new miss if the phase goes to a grasp, else the present one."""
    key = jax.random.fold_in(jax.random.fold_in(script.key, MISS_STREAM), state.step)
    drawn = jnp.array(MISS) * jax.random.uniform(key, (6,), minval=-1.0)
    return jnp.where((phase == DESCEND) | (phase == REACH), drawn, script.miss)


def _following(script: ThrowScript, state: EnvState) -> jax.Array:
    """Returns the next phase: a grasp or a turn that failed is done again."""
    now, phase = state.measurements, script.phase
    is_held, is_inside = now.drive.held, now.drive.is_inside
    is_out = is_inside & (now.drive.emerged >= OUT_ENOUGH)
    following = jnp.minimum(phase + 1, HOLD)
    again = jnp.where(is_inside, jnp.where(is_held, DRIVE, BACK), OVER)
    following = jnp.where((phase == DRIVE) & ~is_out, again, following)
    following = jnp.where((phase == OUT) & ~now.is_through, OPEN, following)
    following = jnp.where((phase == BACK) & ~is_out, APPROACH, following)
    misses = (phase == TAKE) | (phase == OUT)
    following = jnp.where(misses & ~is_held, BACK, following)
    taken = jnp.where(is_held, jnp.where(is_inside, DRIVE, LIFT), APPROACH)
    following = jnp.where(phase == CLOSE, taken, following)
    return following.astype(jnp.int32)


def act(script: ThrowScript, state: EnvState) -> tuple[Command, ThrowScript, Command]:
    """Returns the disturbed command, the script a step later, and the command to record."""
    after = enter(script, _following(script, state), state)
    script, s = phases.advance(script, TIMING, after, state)
    share = scripting.sloped(s)
    is_arc = (script.phase == DRIVE) | (script.phase == OUT)
    on_arc, straight = _on_arc(script, share, state), wrist_script.straight(script, share)
    tip = jax.tree.map(lambda a, b: jnp.where(is_arc, a, b), on_arc, straight)
    settles = jnp.any(script.phase == jnp.array(SETTLES))
    weight, fade = jnp.asarray(DISTURBANCE)[script.phase], jnp.where(settles, 1.0 - s, 1.0)
    nears = (script.phase == DESCEND) | (script.phase == REACH)
    closes = (script.phase == CLOSE) | (script.phase == TAKE)
    miss = jnp.where(nears, share, jnp.where(closes, 1.0, 0.0)) * script.miss
    return wrist_script.commands(script, tip, weight, fade, state, miss)


def _on_arc(script: ThrowScript, share: jax.Array, state: EnvState) -> Pose:
    """Returns pose_world_tip at a fraction of a turn; it begins where the phase did."""
    first, now = (
        tip_of(needles.pose_on(task.SIZE, state.layout.bite, turn), script.held)
        for turn in (script.turn, script.turn + share * (script.turn_end - script.turn))
    )
    return wrist_script.from_start(script, first, now, share)


AGENT = Agent(init, act)
