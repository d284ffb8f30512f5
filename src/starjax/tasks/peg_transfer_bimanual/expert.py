"""Scripted expert of bimanual peg transfer: lift, meet in the air, take over, thread.

Both tools hold the same wall, `SIDE` to either side of its middle; their shafts lean apart and both
jaws open along the world's y. Positions are independent of the trocars. It never retries: a dropped
block is a failure.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from starjax.sim.state import EnvState
from starjax.tasks import handover, phases
from starjax.tasks.peg_transfer import task as single
from starjax.tasks.peg_transfer_bimanual.task import PARK

PHASES = (
    "above", "down", "close", "lift", "carry", "near", "meet", "take", "open", "away",
    "over", "lower", "release", "rise", "wait",
)  # fmt: skip
# s, of each phase at tempo 1; jaws of both arms at its end.
DURATION = (1.6, 1.1, 0.0, 0.9, 1.0, 0.9, 0.8, 0.0, 0.0, 0.6, 1.2, 0.9, 0.0, 0.7, 1.0)
GIVER = (1, 1, -1, -1, -1, -1, -1, -1, 1, 1, 1, 1, 1, 1, 1)
TAKER = (1, 1, 1, 1, 1, 1, 1, -1, -1, -1, -1, -1, 1, 1, 1)
# Arms that turn to the wall, by phase; the others keep their roll.
LOOKS = np.zeros((len(PHASES), 2), bool)
LOOKS[1, 0] = LOOKS[[6, 10, 11], 1] = True
# Weight of the disturbance in each phase.
DISTURBANCE = (1, 0.4, 0, 0.1, 0.3, 0.3, 0.1, 0, 0, 0, 0.3, 0.1, 0, 0.3, 0)

TEMPO = (0.9, 1.15)  # range of an episode's pace
# 1/m, roll (its sine) that is accepted to hold the wall at the back of the block's path: a block
# sinks about the wall that holds it, and on the path the shafts' lean raises it again.
RAISED = 5.0
SIDE = 0.0048  # m along the wall, from its middle to either tool
PLACE = (0.0, 0.0, 0.045)  # m, of the block at the hand-over
# Fraction of the ways in after which a tool has turned, and in "down" is above its goal.
ALIGNED = 0.6
HOVER = 0.026  # m above a grasp
GRASP_DROP = 0.001  # m below the rim's centre line
OVER = 0.012  # m more above the target: the block hangs below the taker
RELEASE_HEIGHT = 0.0012  # m above the grasp's height, of the release
RELEASE_SHIFT = 0.0005  # m further out along the wall's normal: room for the inner pad
COME = (0.0125, 0.0, 0.0215)  # m, start of the taker's way to the wall
GO = (-0.015, 0.0, 0.026)  # m, the giver's way after the release
# m, the taker's: along its shaft, which leans to that side and would sweep the block, straight up
OFF = (0.015, 0.0, 0.026)


def _choose(key: jax.Array, state: EnvState) -> tuple[jax.Array, jax.Array, Any]:
    """Chooses a wall with little roll from which the block hangs well, and draws the pace.

    The wall is given as its normal `[3]` and its direction `[3]` in the block's frame.
    """
    key, key_tempo = jax.random.split(key)
    block = state.measurements.block
    normals = single.wall_normals(block)
    way = state.layout.target_peg[1] - block.p[1]
    # |n_x| is the sine of the roll; the second term prefers the wall at the back of the path.
    out = normals[jnp.argmin(jnp.abs(normals[:, 0]) + RAISED * way * normals[:, 1])]
    along = jnp.cross(block.R[:, 2], out)
    along = along * jnp.where(along[0] < 0, -1.0, 1.0)  # towards +x: the taker's side
    tempo = jax.random.uniform(key_tempo, minval=TEMPO[0], maxval=TEMPO[1])
    return key, tempo, (block.R.T @ out, block.R.T @ along)  # in the block: it tilts in the jaws


def _following(script: handover.HandoverScript, state: EnvState) -> jax.Array:
    return jnp.minimum(script.phase + 1, len(PHASES) - 1)


def _weight(phase: jax.Array, fraction: jax.Array) -> jax.Array:
    return jnp.asarray(DISTURBANCE, jnp.float32)[phase]


def _goals(script: handover.HandoverScript, state: EnvState) -> tuple[jax.Array, jax.Array]:
    """Returns the tips' goals of every phase from the present state, and the wall's normal."""
    block, tips = state.measurements.block, script.p
    wall, along = script.held
    out, along = block.R @ wall, block.R @ along
    flat = phases.horizontal(out)
    normal = phases.towards_arm(flat)
    outside = handover.OUT * flat
    low = jnp.array([0.0, 0.0, -GRASP_DROP])
    give, take = (
        block.p + single.RIM_RADIUS * out + side * SIDE * along + low for side in (-1.0, 1.0)
    )
    park, up = jnp.array(PARK), jnp.array([0.0, 0.0, HOVER])
    carried = tips[0] + jnp.array(PLACE) - block.p  # moves the block to PLACE, not the tip
    # The taker's position once the block is upright over the target peg.
    tangent = jnp.array([-flat[1], flat[0]])
    aside = ((state.pose.p[1] - block.p)[:2] @ tangent) * tangent
    over = state.layout.target_peg + (single.RIM_RADIUS + RELEASE_SHIFT) * flat[:2] + aside
    height = single.RIM_HEIGHT - GRASP_DROP
    held = tips
    goals = jnp.stack(
        [
            jnp.stack([give + outside + up, park[1]]),  # above
            jnp.stack([give, park[1]]),  # down
            held,
            held.at[0].add(up),  # lift
            jnp.stack([carried, park[1]]),  # carry
            jnp.stack([tips[0], take + outside + jnp.array(COME)]),  # near
            jnp.stack([tips[0], take]),  # meet
            held,
            held,
            held.at[0].add(jnp.array(GO)),  # away
            jnp.stack([park[0], jnp.append(over, height + HOVER + OVER)]),  # over
            jnp.stack([park[0], jnp.append(over, height + RELEASE_HEIGHT)]),  # lower
            held,
            held.at[1].add(jnp.array(OFF)),  # rise
            held.at[1, 2].set(jnp.clip(PARK[1][2], tips[1, 2], tips[1, 2] + phases.RISE)),  # wait
        ]
    )
    return goals, normal


PLAY = handover.Play(
    choose=_choose,
    duration=np.array(DURATION),
    jaws=np.stack([GIVER, TAKER], -1),
    aligned=np.where(np.array(PHASES) == "down", ALIGNED, 1.0),
    turned=np.where(np.isin(PHASES, ("down", "meet")), ALIGNED, 1.0),
    looks=LOOKS,
    weight=_weight,
    following=_following,
    goals=_goals,
)
AGENT = handover.agent(PLAY)
