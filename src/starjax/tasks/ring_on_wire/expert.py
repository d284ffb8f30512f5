"""Scripted expert of ring on wire: take the tab, lift the ring free, carry it along, let it hang.

It goes from bend to bend and stops at each. With a straight tool the tip's position for a ring's
pose depends on the grasp and on the tool's lean, hence on the trocar. Pace, the point on the tab
and the side of approach are drawn, never by the trocar. It is disturbed on purpose, and starts over
if it does not hold the tab.
"""

import flax.struct
import jax
import jax.numpy as jnp

from starjax.core.types import Agent, Command, Pose
from starjax.sim.state import EnvState
from starjax.tasks import phases, scripting
from starjax.tasks.phases import ALIGNED, APPROACH, DESCEND, RAISE
from starjax.tasks.ring_on_wire import task

CLOSE, LIFT, CARRY, LOWER, OPEN, LEAVE, WAIT = range(3, 10)
TIMING = phases.PhaseTable(
    duration=(0.5, 1.2, 0.9, 0.0, 1.2, 0.2, 0.8, 0.0, 0.7, 0.8),
    speed=(0.04, 0.04, 0.024, 1.0, 0.022, 0.0165, 0.022, 1.0, 0.03, 1.0),
    jaws=(1.0, 1.0, 1.0, -1.0, -1.0, -1.0, -1.0, 1.0, 1.0, 1.0),
    tempo=(0.85, 1.15),
)
# Weight of the disturbance at the end of each phase.
DISTURBANCE = (1.0, 1.0, 0.0, 0.0, 0.1, 0.15, 0.0, 0.0, 0.3, 0.1)

HOVER = 0.02  # m along the shaft before the tab
HOVER_ASIDE = 0.006  # m along the wire, either way
GRASP_SPREAD = 0.0008  # m along the tab, either way
RELEASE = 0.55  # fraction of the way down to the hanging ring, of the release
SMOOTHED = 0.003  # m to either side over which the wire's direction is taken
DEVIATION = (0.0012, 0.0012, 0.0012, 0.05)  # m and rad, of the disturbance
STOPS = (*task.BENDS[1:-1], task.START)  # m along the way
AHEAD = 0.001  # m, the least way to the next stop
ROUNDS = 4  # fixed-point iterations for a pose whose roll and position depend on each other


@flax.struct.dataclass
class RingScript(phases.PhaseScript):
    """Progress of the script in one episode; positions have the roll in front.

    Attributes:
      side: 1 or -1, side of the approach.
      grasp: m along the tab, from the ring's centre.
      stop: `[]` m along the way, end of the present carry.
    """

    side: jax.Array
    grasp: jax.Array
    stop: jax.Array


def init(key: jax.Array, state: EnvState) -> RingScript:
    """Starts the script of an episode."""
    own = {"side": jnp.ones(()), "grasp": jnp.zeros(()), "stop": jnp.zeros(())}
    script = phases.begin(RingScript, TIMING, key, jnp.append(0.0, state.pose.p[0]), **own)
    return _enter(script, jnp.asarray(APPROACH, jnp.int32), state)


def act(script: RingScript, state: EnvState) -> tuple[Command, RingScript, Command]:
    """Returns the disturbed command to execute, the script, and the undisturbed one to record."""
    after = _enter(script, _following(script, state), state)
    script, s = phases.advance(script, TIMING, after, state)
    fraction = scripting.sloped(s)
    way = script.start + fraction * (script.goal - script.start)  # [roll, p]
    # On the way down the tool has turned, and goes along its shaft, before it can touch.
    early = scripting.sloped(jnp.minimum(s / ALIGNED, 1.0))
    shaft = _shaft(script.goal[1:], state)
    # Along the shaft, not straight down: a leaning shaft would sweep the wire.
    back = HOVER * (1.0 - fraction) * shaft
    aside = (1.0 - early) * (script.start + jnp.append(0.0, HOVER * shaft) - script.goal)
    way = jnp.where(script.phase == DESCEND, (script.goal + aside).at[1:].add(-back), way)
    noise = scripting.disturb(script.key, script.noise, state.step, jnp.array(DEVIATION))
    weights = jnp.asarray(DISTURBANCE)
    before, weight = weights[jnp.maximum(script.phase - 1, 0)], weights[script.phase]
    moved = (before + fraction * (weight - before)) * jnp.roll(noise[1], 1)  # noise is [p, roll]
    script = script.replace(at=way, noise=noise)
    return _command(way + moved, script.jaws, state), script, _command(way, script.jaws, state)


def _following(script: RingScript, state: EnvState) -> jax.Array:
    """Returns the next phase: another carry, or the first one if the tab is not held."""
    is_carry, is_there = script.phase == CARRY, script.stop >= STOPS[-1] - 1e-6
    # From stop to stop along the wire
    following = jnp.where(is_carry & ~is_there, CARRY, script.phase + 1)
    is_held = (script.phase >= LIFT) & (script.phase <= CARRY)
    following = jnp.where(is_held & ~state.measurements.touch, RAISE, following)
    is_away = state.layout.way * state.measurements.ring.p[1] < task.END  # it slid back: once more
    at_last = jnp.where(is_away, RAISE, WAIT)
    return jnp.where(script.phase >= LEAVE, at_last, following).astype(jnp.int32)


def _enter(script: RingScript, phase: jax.Array, state: EnvState) -> RingScript:
    """Begins `phase` with a goal from the present state."""
    ring, here = state.measurements.ring, script.at
    is_approach = phase == APPROACH
    attempt = script.attempt + is_approach
    key_side, key_grasp = jax.random.split(jax.random.fold_in(script.key, attempt))
    side = jax.random.rademacher(key_side, (), jnp.float32)
    side = jnp.where(is_approach, side, script.side)
    spread = jax.random.uniform(key_grasp, minval=-GRASP_SPREAD, maxval=GRASP_SPREAD)
    grasp = jnp.where(is_approach, task.TAB + spread, script.grasp)
    at_tab = ring.p + grasp * ring.R[:, 2]
    shaft = _shaft(at_tab, state)
    normal = phases.towards_arm(ring.R[:, 1])
    above = at_tab - HOVER * shaft + jnp.array([0.0, HOVER_ASIDE, 0.0]) * side
    progress = state.layout.way * ring.p[1]  # m towards the goal: `way` is the direction, +1 or -1
    stops = jnp.array(STOPS)
    # The next stop well ahead of the ring: a ring that has slipped back is carried again.
    following = jnp.min(jnp.where(stops > progress + AHEAD, stops, STOPS[-1]))
    stop = jnp.where(phase == LIFT, progress, jnp.where(phase == CARRY, following, script.stop))
    on_wire = _carrying(state.layout.way * stop, jnp.zeros(()), here[0], state)
    hung = _carrying(state.layout.way * stop, jnp.array(RELEASE), here[0], state)
    leaving = here.at[1:].add(-HOVER * _shaft(here[1:], state))
    goals = [
        here.at[3].set(jnp.maximum(here[3], task.TIP_HOME[2])),  # RAISE
        _turned(above, normal, here[0], state),  # APPROACH
        _turned(at_tab, normal, here[0], state),  # DESCEND
        here,
        on_wire,
        on_wire,
        hung,  # LOWER
        here,
        leaving,  # LEAVE
        here.at[3].set(jnp.clip(task.TIP_HOME[2], here[3], here[3] + phases.RISE)),  # WAIT
    ]
    own = {"attempt": attempt, "side": side, "grasp": grasp, "stop": stop}
    return phases.enter(script, TIMING, phase, goals, **own)


def _carrying(y: jax.Array, lowered: jax.Array, roll: jax.Array, state: EnvState) -> jax.Array:
    """Returns roll and position `[4]` that hold the ring, in its present grasp, about the wire.

    Args:
      y: m, position along the wire.
      lowered: fraction of the way down to the hanging ring.
      roll: rad, the present one.
    """
    point = jnp.stack([jnp.zeros(()), y, task.height(y) - lowered * task.HANG])
    rise = task.height(y + SMOOTHED) - task.height(y - SMOOTHED)
    # The ring's plane stays across the wire: its normal is the wire's tangent, by a central
    # difference.
    normal = -jnp.stack([jnp.zeros(()), jnp.array(2.0 * SMOOTHED), rise])
    held: Pose = jax.tree.map(lambda leaf: leaf[0], state.pose)
    in_tool = held.R.T @ (state.measurements.ring.p - held.p)  # p_tip_ring of the present grasp
    way = jnp.append(roll, held.p)
    # Fixed point: the roll depends on the tip, which depends on the roll through the grasp.
    for _ in range(ROUNDS):
        way = _turned(way[1:], normal, roll, state)
        R = _command(way, jnp.zeros(()), state).pose.R[0]
        way = way.at[1:].set(point - R @ in_tool)  # puts the ring's centre on the wire
    return way


def _turned(p: jax.Array, normal: jax.Array, roll: jax.Array, state: EnvState) -> jax.Array:
    """Returns roll and position `[4]` at `p`, jaws along `normal`, the roll nearest to `roll`."""
    R = _command(jnp.append(0.0, p), jnp.zeros(()), state).pose.R[0]
    # Turns the jaws' y axis to the normal
    turned = jnp.arctan2(-normal @ R[:, 0], normal @ R[:, 1])
    return jnp.append(scripting.nearer_half(turned, roll), p)


def _shaft(p: jax.Array, state: EnvState) -> jax.Array:
    """Returns the direction `[3]` of a shaft with its tip at `p`."""
    away = p - state.measured_trocar.p_world_trocar[0]
    return away / jnp.linalg.norm(away)


def _command(way: jax.Array, jaws: jax.Array, state: EnvState) -> Command:
    return scripting.command(way[:1], way[None, 1:], jaws[None], state)


AGENT = Agent(init, act)
