"""Scripted expert of needle hand-over: pick up, meet in the air, take over, hold.

The tools hold the wire two to four segments apart, the one that takes over nearer to its own side.
Which pair is drawn among those across which both jaws open without much of a turn; wanted positions
never look at a trocar. It tries again where a tool has missed the wire; a needle that is dropped is
a failure.
"""

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.sim.state import EnvState
from starjax.sim.tasks import scripting
from starjax.sim.tasks.base import CONTROL_HZ
from starjax.sim.tasks.needle_handover.task import PARK
from starjax.sim.tasks.needle_pick import task as single
from starjax.types import Agent, Command

PHASES = (
    "above", "down", "close", "lift", "carry", "near", "meet", "take", "open", "away", "raise",
    "hold",
)  # fmt: skip
# s, of each phase at tempo 1; jaws of both arms at its end.
DURATION = (1.6, 1.1, 0.5, 0.9, 1.2, 1.2, 1.0, 0.5, 0.4, 0.8, 0.8, 1.0)
GIVER = (1, 1, -1, -1, -1, -1, -1, -1, 1, 1, 1, 1)
TAKER = (1, 1, 1, 1, 1, 1, 1, -1, -1, -1, -1, -1)
# Which arms turn to their segment in which phase; the others keep their turn.
LOOKS = np.zeros((len(PHASES), 2), bool)
LOOKS[[0, 1], 0] = LOOKS[[5, 6], 1] = True
# How much of the disturbance acts at the end of each phase.
DISTURBANCE = (1, 0, 0, 0.1, 0.3, 0.3, 0, 0, 0, 0, 0.1, 0.1)

TEMPO = (0.9, 1.15)  # range of an episode's pace
JAW_TIME = 0.25  # s to close or open
ALIGNED = 0.6  # share of a phase that goes down after which it goes straight down
MEET = (0.0, 0.0, 0.04)  # m, of the giver's segment at the hand-over
HOVER = 0.02  # m above a grasp
GRASP_ABOVE = 0.001  # m of the tip above the wire: the pads' ends lie 1.5 mm below it
COME = (0.012, 0.0, 0.021)  # m, from where the taker comes to the wire
GO = (-0.015, 0.0, 0.026)  # m, where the giver goes once it has let go
RAISE = 0.01  # m
SKEW = 0.1  # sine of the angle between jaws and the world's y at which a preference shows
ASIDE = 150.0  # 1/m, what it is worth that the taker's segment lies on its own side
DEVIATION = (0.001, 0.001, 0.001, 0.04)  # m and rad, of the disturbance of each arm
CORRELATION, SMOOTHING = 0.4, 0.15  # s
MIDDLES, TANGENTS = single.segments()
INNER = range(1, single.SEGMENTS - 1)
PAIRS = np.array([(a, b) for a in INNER for b in INNER if abs(a - b) > 1])  # giver's, taker's


@flax.struct.dataclass
class Script:
    """Where the script stands; single episode. Arrays `[2, ...]` are of both arms.

    Attributes:
      key: of everything random. phase: int32. elapsed: s. tempo: pace.
      segments: `[2]` int32, of the wire.
      start, goal, p: `[2, 3]` m, undisturbed positions. normal: `[2, 3]`, what the jaws open along.
      roll_from, roll_to, roll: `[2]` rad. jaws_from, jaws: `[2]`.
      noise: `[2, 8]` disturbance of both arms, rough and smooth.
    """

    key: jax.Array
    phase: jax.Array
    elapsed: jax.Array
    tempo: jax.Array
    segments: jax.Array
    start: jax.Array
    goal: jax.Array
    p: jax.Array
    normal: jax.Array
    roll_from: jax.Array
    roll_to: jax.Array
    roll: jax.Array
    jaws_from: jax.Array
    jaws: jax.Array
    noise: jax.Array


def init(key: jax.Array, state: EnvState) -> Script:
    """Draws the pair of segments and the pace."""
    key, key_tempo, key_pair = jax.random.split(key, 3)
    R, p = state.facts.needle.R, state.pose.p
    give, take = PAIRS.T
    skew = jnp.abs(TANGENTS @ R[1])  # of each segment's normal from the world's y
    aside = (MIDDLES[take] - MIDDLES[give]) @ R[0]
    score = (ASIDE * aside - skew[give] - skew[take]) / SKEW
    pair = jax.random.categorical(key_pair, score)
    zero, open_ = jnp.zeros(2), jnp.ones(2)
    script = Script(
        key=key,
        phase=jnp.zeros((), jnp.int32),
        elapsed=jnp.zeros(()),
        tempo=jax.random.uniform(key_tempo, minval=TEMPO[0], maxval=TEMPO[1]),
        segments=jnp.asarray(PAIRS)[pair],
        start=p,
        goal=p,
        p=p,
        normal=jnp.tile(jnp.array([0.0, -1.0, 0.0]), (2, 1)),
        roll_from=zero,
        roll_to=zero,
        roll=zero,
        jaws_from=open_,
        jaws=open_,
        noise=jnp.zeros((2, 8)),
    )
    return _enter(script, jnp.zeros((), jnp.int32), state)


def act(script: Script, state: EnvState) -> tuple[Command, Script, Command]:
    """The disturbed commands to execute, the script, and the undisturbed ones to record."""
    dt = 1.0 / CONTROL_HZ
    duration = jnp.asarray(DURATION)[script.phase] / script.tempo
    is_over = script.elapsed >= duration - 1e-6
    after = _enter(script, _following(script, state), state)
    script = jax.tree.map(lambda a, b: jnp.where(is_over, a, b), after, script)
    elapsed = script.elapsed + dt
    s = jnp.clip(elapsed * script.tempo / jnp.asarray(DURATION)[script.phase], 0.0, 1.0)
    # On the way down the giver is over its goal by the time anything can touch.
    aligned = jnp.where(script.phase == PHASES.index("down"), ALIGNED, 1.0)
    aside = scripting.minimum_jerk(jnp.minimum(s / aligned, 1.0))
    share = scripting.minimum_jerk(s)
    wanted = jnp.stack([jnp.asarray(GIVER), jnp.asarray(TAKER)], -1)[script.phase]
    noise = scripting.disturb(
        script.key,
        script.noise,
        state.step,
        deviation=jnp.array(DEVIATION * 2),
        correlation=CORRELATION,
        smoothing=SMOOTHING,
        dt=dt,
    )
    script = script.replace(
        elapsed=elapsed,
        p=script.start + jnp.stack([aside, aside, share]) * (script.goal - script.start),
        roll=script.roll_from + aside * (script.roll_to - script.roll_from),
        jaws=script.jaws_from
        + jnp.clip(elapsed / JAW_TIME, 0.0, 1.0) * (wanted - script.jaws_from),
        noise=noise,
    )
    weights = jnp.asarray(DISTURBANCE, jnp.float32)
    before, weight = weights[jnp.maximum(script.phase - 1, 0)], weights[script.phase]
    moved = (before + share * (weight - before)) * noise[1].reshape(2, 4)
    rough = _command(script.roll + moved[:, 3], script.p + moved[:, :3], script.jaws, state)
    return rough, script, _command(script.roll, script.p, script.jaws, state)


def _following(script: Script, state: EnvState) -> jax.Array:
    """The phase after the present one: back to where a tool came from if it missed the wire."""
    missed = (script.phase == PHASES.index("lift")) & ~state.facts.touch[0]
    following = jnp.where(missed, 0, jnp.minimum(script.phase + 1, len(PHASES) - 1))
    missed = (script.phase == PHASES.index("take")) & ~state.facts.touch[1]
    return jnp.where(missed, PHASES.index("near"), following).astype(jnp.int32)


def _enter(script: Script, phase: jax.Array, state: EnvState) -> Script:
    """Begins `phase` with goals from what is seen now."""
    needle, tips = state.facts.needle, script.p
    across = jnp.cross(
        jnp.asarray(TANGENTS)[script.segments] @ needle.R.T, jnp.array([0.0, 0.0, 1.0])
    )
    across = across / jnp.maximum(jnp.linalg.norm(across, axis=-1, keepdims=True), 1e-6)
    normal = across * jnp.where(across[:, 1:2] > 0, -1.0, 1.0)
    wire = needle.p + jnp.asarray(MIDDLES)[script.segments] @ needle.R.T
    give, take = wire + jnp.array([0.0, 0.0, GRASP_ABOVE])
    park, up = jnp.array(PARK), jnp.array([0.0, 0.0, HOVER])
    goals = jnp.stack(
        [
            jnp.stack([give + up, park[1]]),
            jnp.stack([give, park[1]]),
            tips,
            tips.at[0].add(up),
            jnp.stack([tips[0] + jnp.array(MEET) - wire[0], park[1]]),
            jnp.stack([tips[0], take + jnp.array(COME)]),
            jnp.stack([tips[0], take]),
            tips,
            tips,
            tips.at[0].add(jnp.array(GO)),
            tips.at[1, 2].add(RAISE),
            tips,
        ]
    )
    goal = goals[phase]
    normals = jnp.where(jnp.asarray(LOOKS)[phase][:, None], normal, script.normal)
    at_zero = _command(jnp.zeros(2), goal, script.jaws, state).pose.R
    seen = jnp.einsum("ai,aij->aj", normals, at_zero, precision="highest")
    turned = jnp.arctan2(-seen[:, 0], seen[:, 1])
    # Jaws are the same after half a turn: the nearer of the two.
    roll_to = script.roll + (turned - script.roll + jnp.pi / 2) % jnp.pi - jnp.pi / 2
    return script.replace(
        phase=phase,
        elapsed=jnp.zeros(()),
        start=tips,
        goal=goal,
        normal=normals,
        roll_from=script.roll,
        roll_to=roll_to,
        jaws_from=script.jaws,
    )


def _command(roll: jax.Array, p: jax.Array, jaws: jax.Array, state: EnvState) -> Command:
    pose, _ = rcm.ACTION_SPACES["rcm4"].decode(jnp.concatenate([roll[:, None], p], -1), state.told)
    return Command(pose, jaws)


AGENT = Agent(init, act)
