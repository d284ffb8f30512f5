"""Scripted expert of needle hand-over: pick up, meet in the air, take over, hold.

The tools hold the wire two to four segments apart, the one that takes over nearer to its own side.
Which pair is drawn among those across which both jaws open without much of a turn; wanted positions
never look at a trocar. It tries again where a tool has missed the wire; a needle that is dropped is
a failure.
"""

import jax
import jax.numpy as jnp
import numpy as np

from starjax.sim.state import EnvState
from starjax.sim.tasks import handover
from starjax.sim.tasks.needle_handover.task import PARK
from starjax.sim.tasks.needle_pick import task as single

PHASES = (
    "above", "down", "close", "lift", "carry", "near", "meet", "rest", "take", "open", "away",
    "raise", "hold",
)  # fmt: skip
# s, of each phase at tempo 1; jaws of both arms at its end.
DURATION = (1.6, 1.1, 0.5, 0.9, 1.2, 1.2, 1.0, 0.3, 0.5, 0.4, 0.8, 0.8, 1.0)
GIVER = (1, 1, -1, -1, -1, -1, -1, -1, -1, 1, 1, 1, 1)
TAKER = (1, 1, 1, 1, 1, 1, 1, 1, -1, -1, -1, -1, -1)
# Which arms turn to their segment in which phase; the others keep their turn.
LOOKS = np.zeros((len(PHASES), 2), bool)
LOOKS[1, 0] = LOOKS[6, 1] = True
# How much of the disturbance acts at the end of each phase: also where a tool comes to the wire, so
# that it is shown what to do a little beside it.
DISTURBANCE = (1, 0.4, 0, 0.1, 0.3, 0.5, 0.4, 0.2, 0, 0, 0, 0.1, 0.1)

TEMPO = (0.9, 1.15)  # range of an episode's pace
ALIGNED = 0.6  # share of the ways in after which a tool has turned, and of "down", is over its goal
MEET = (0.0, 0.0, 0.04)  # m, of the giver's segment at the hand-over
HOVER = 0.02  # m above a grasp
GRASP_ABOVE = 0.001  # m of the tip above the wire: the pads' ends lie 1.5 mm below it
COME = (0.012, 0.0, 0.021)  # m, from where the taker comes to the wire
GO = (-0.015, 0.0, 0.026)  # m, where the giver goes once it has let go
RAISE = 0.01  # m
SKEW = 0.1  # sine of the angle between jaws and the world's y at which a preference shows
ASIDE = 150.0  # 1/m, what it is worth that the taker's segment lies on its own side
MIDDLES, TANGENTS = single.segments()
INNER = range(1, single.SEGMENTS - 1)
PAIRS = np.array([(a, b) for a in INNER for b in INNER if abs(a - b) > 1])  # giver's, taker's


def _choose(key: jax.Array, state: EnvState) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The pair of segments, int32 `[2]`, and the pace."""
    key, key_tempo, key_pair = jax.random.split(key, 3)
    R = state.measurements.needle.R
    give, take = PAIRS.T
    skew = jnp.abs(TANGENTS @ R[1])  # of each segment's normal from the world's y
    aside = (MIDDLES[take] - MIDDLES[give]) @ R[0]
    score = (ASIDE * aside - skew[give] - skew[take]) / SKEW
    pair = jax.random.categorical(key_pair, score)
    tempo = jax.random.uniform(key_tempo, minval=TEMPO[0], maxval=TEMPO[1])
    return key, tempo, jnp.asarray(PAIRS)[pair]


def _following(script: handover.HandoverScript, state: EnvState) -> jax.Array:
    """The phase after the present one: back to where a tool came from if it missed the wire."""
    missed = (script.phase == PHASES.index("lift")) & ~state.measurements.touch[0]
    following = jnp.where(missed, 0, jnp.minimum(script.phase + 1, len(PHASES) - 1))
    missed = (script.phase == PHASES.index("take")) & ~state.measurements.touch[1]
    return jnp.where(missed, PHASES.index("near"), following).astype(jnp.int32)


def _weight(phase: jax.Array, share: jax.Array) -> jax.Array:
    weights = jnp.asarray(DISTURBANCE, jnp.float32)
    before, weight = weights[jnp.maximum(phase - 1, 0)], weights[phase]
    return before + share * (weight - before)


def _goals(script: handover.HandoverScript, state: EnvState) -> tuple[jax.Array, jax.Array]:
    """Where the tips go in every phase, from what is seen now, and across what the jaws open."""
    needle, tips = state.measurements.needle, script.p
    across = jnp.cross(jnp.asarray(TANGENTS)[script.held] @ needle.R.T, jnp.array([0.0, 0.0, 1.0]))
    across = across / jnp.maximum(jnp.linalg.norm(across, axis=-1, keepdims=True), 1e-6)
    normal = across * jnp.where(across[:, 1:2] > 0, -1.0, 1.0)
    wire = needle.p + jnp.asarray(MIDDLES)[script.held] @ needle.R.T
    give, take = wire + jnp.array([0.0, 0.0, GRASP_ABOVE])
    out = handover.OUT * across
    park, up = jnp.array(PARK), jnp.array([0.0, 0.0, HOVER])
    goals = jnp.stack(
        [
            jnp.stack([give + out[0] + up, park[1]]),
            jnp.stack([give, park[1]]),
            tips,
            tips.at[0].add(up),
            jnp.stack([tips[0] + jnp.array(MEET) - wire[0], park[1]]),
            jnp.stack([tips[0], take + out[1] + jnp.array(COME)]),
            jnp.stack([tips[0], take]),
            tips,
            tips,
            tips,
            tips.at[0].add(jnp.array(GO)),
            tips.at[1, 2].add(RAISE),
            tips,
        ]
    )
    return goals, normal


PLAY = handover.Play(
    choose=_choose,
    duration=np.array(DURATION),
    jaws=np.stack([GIVER, TAKER], -1),
    aligned=np.where(np.array(PHASES) == "down", ALIGNED, 1.0),
    turned=np.where(LOOKS.any(-1), ALIGNED, 1.0),
    looks=LOOKS,
    weight=_weight,
    following=_following,
    goals=_goals,
)
AGENT = handover.agent(PLAY)
