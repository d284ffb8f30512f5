"""Scripted expert of needle hand-over: pick up, meet in the air, take over, hold.

The tools hold the wire two to four segments apart, the taker nearer to its own side. The pair is
drawn among those that need little roll of both tools; positions are independent of the trocars. A
tool that has missed the wire tries again; a dropped needle is a failure.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from starjax.sim.state import EnvState
from starjax.tasks import handover, phases
from starjax.tasks.needle_handover.task import PARK
from starjax.tasks.needle_pick import task as single

PHASES = (
    "above", "down", "close", "lift", "carry", "near", "meet", "take", "open", "away", "raise",
    "hold",
)  # fmt: skip
# s, of each phase at tempo 1; jaws of both arms at its end.
DURATION = (1.6, 1.1, 0.0, 0.9, 1.2, 1.2, 1.0, 0.0, 0.0, 0.8, 2.4, 1.0)
GIVER = (1, 1, -1, -1, -1, -1, -1, -1, 1, 1, 1, 1)
TAKER = (1, 1, 1, 1, 1, 1, 1, -1, -1, -1, -1, -1)
# Arms that turn to their segment, by phase; the others keep their roll.
LOOKS = np.zeros((len(PHASES), 2), bool)
LOOKS[1, 0] = LOOKS[6, 1] = True
# Weight of the disturbance at the end of each phase. It acts near the wire too, to demonstrate
# corrections there.
DISTURBANCE = (1, 0.4, 0, 0.1, 0.3, 0.5, 0.2, 0, 0, 0, 0.1, 0.1)

TEMPO = (0.9, 1.15)  # range of an episode's pace
# Fraction of the ways in after which a tool has turned, and in "down" is above its goal.
ALIGNED = 0.6
MEET = (0.0, 0.0, 0.04)  # m, of the giver's segment at the hand-over
HOVER = 0.02  # m above a grasp
GRASP_ABOVE = 0.001  # m of the tip above the wire: the pads' ends lie 1.5 mm below it
COME = (0.012, 0.0, 0.021)  # m, start of the taker's way to the wire
GO = (-0.015, 0.0, 0.026)  # m, the giver's way after the release
# m, slowly, then more in holds: the needle settles in the jaws, and no command stands still
RAISE, TOP = 0.03, 0.012
SKEW = 0.1  # sine of the angle between jaws and the world's y at which a preference shows
ASIDE = 150.0  # 1/m, preference for a taker's segment on its own side
MIDDLES, TANGENTS = single.segments()
INNER = range(1, single.SEGMENTS - 1)
PAIRS = np.array([(a, b) for a in INNER for b in INNER if abs(a - b) > 1])  # giver's, taker's


def _choose(key: jax.Array, state: EnvState) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Draws the pair of segments, int32 `[2]`, and the pace."""
    key, key_tempo, key_pair = jax.random.split(key, 3)
    R = state.measurements.needle.R
    give, take = PAIRS.T
    skew = jnp.abs(TANGENTS @ R[1])  # tilt of each segment's normal from the world's y
    aside = (MIDDLES[take] - MIDDLES[give]) @ R[0]  # m along x: the taker comes from +x
    score = (ASIDE * aside - skew[give] - skew[take]) / SKEW
    # Drawn with the preference as logits: neighbours of the best pair are demonstrated too.
    pair = jax.random.categorical(key_pair, score)
    tempo = jax.random.uniform(key_tempo, minval=TEMPO[0], maxval=TEMPO[1])
    return key, tempo, jnp.asarray(PAIRS)[pair]


def _following(script: handover.HandoverScript, state: EnvState) -> jax.Array:
    """Returns the next phase, an earlier one if a tool missed the wire."""
    missed = (script.phase == PHASES.index("lift")) & ~state.measurements.touch[0]  # the giver
    following = jnp.where(missed, 0, jnp.minimum(script.phase + 1, len(PHASES) - 1))
    missed = (script.phase == PHASES.index("take")) & ~state.measurements.touch[1]  # the taker
    return jnp.where(missed, PHASES.index("near"), following).astype(jnp.int32)


def _weight(phase: jax.Array, fraction: jax.Array) -> jax.Array:
    weights = jnp.asarray(DISTURBANCE, jnp.float32)
    before, weight = weights[jnp.maximum(phase - 1, 0)], weights[phase]
    return before + fraction * (weight - before)  # no jump between phases


def goals(
    above: float, script: handover.HandoverScript, state: EnvState
) -> tuple[jax.Array, jax.Array]:
    """Returns the tips' goals of every phase from the present state, and the wire's normals.

    Args:
      above: m of the tips above the wire.
      script, state: as of a `Play`.
    """
    needle, tips = state.measurements.needle, script.p
    # Horizontal normals of both segments, from the needle as it lies now: it turns in the jaws.
    across = jnp.cross(jnp.asarray(TANGENTS)[script.held] @ needle.R.T, jnp.array([0.0, 0.0, 1.0]))
    across = across / jnp.maximum(jnp.linalg.norm(across, axis=-1, keepdims=True), 1e-6)
    normal = across * jnp.where(across[:, 1:2] > 0, -1.0, 1.0)
    wire = needle.p + jnp.asarray(MIDDLES)[script.held] @ needle.R.T  # [2, 3]: giver's, taker's
    give, take = wire + jnp.array([0.0, 0.0, above])
    out = handover.OUT * across
    park, up = jnp.array(PARK), jnp.array([0.0, 0.0, HOVER])
    lifted, high = state.layout.needle.p[2] + above + HOVER, MEET[2] + above + RAISE
    goals = jnp.stack(
        [
            jnp.stack([give + out[0] + up, park[1]]),  # above
            jnp.stack([give, park[1]]),  # down
            tips.at[0].set(give),  # close
            tips.at[0, 2].max(lifted),  # lift
            jnp.stack([tips[0] + jnp.array(MEET) - wire[0], park[1]]),  # carry
            jnp.stack([tips[0], take + out[1] + jnp.array(COME)]),  # near
            jnp.stack([tips[0], take]),  # meet
            tips.at[1].set(take),  # take
            tips,
            tips.at[0].set(give + jnp.array(GO)),  # away
            tips.at[1, 2].max(high),  # raise
            tips.at[1, 2].set(jnp.clip(high + TOP, tips[1, 2], tips[1, 2] + phases.RISE)),  # hold
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
    goals=functools.partial(goals, GRASP_ABOVE),
)
AGENT = handover.agent(PLAY)
