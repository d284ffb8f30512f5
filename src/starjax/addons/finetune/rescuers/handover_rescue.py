"""Entry of a scripted hand-over into an episode that another agent began.

It continues from the tools' places: open jaws above their grasp come down, and every motion keeps
the tools' speed.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from starjax.addons.finetune.rescuers import midway, way_in
from starjax.sim.rescuer import Entry, entry
from starjax.sim.state import EnvState
from starjax.tasks import handover, scripting

MET = 0.006  # m, distance of the object from the place of the pass, at which the taker comes
# m, horizontally from its grasp, at which a tip is above it: open jaws have more room
ASIDE = 0.0015
THERE = 0.0012  # m from its grasp, from which jaws close: they are led to it meanwhile
ABOUT = 0.02  # m from its grasp, within which a tip does not turn away from it
EMPTY = -0.65  # measured opening: about -0.5 on a wire, -0.3 on a wall, -0.8 or less without


def enter(
    play: handover.Play,
    script: handover.HandoverScript,
    phase: jax.Array,
    held: Any,
    state: EnvState,
) -> handover.HandoverScript:
    """Returns the script in the middle of `phase`, or of the next one if its goal is reached.

    Args:
      play: of the script.
      script: from the expert's `init` at this state.
      phase: int32.
      held: the task's own, the held part of the object.
      state: at the entry.
    """
    now = entry(state)
    # As in demonstrations, jaws keep their direction once they have turned to their grasp; before,
    # they turn back to the demonstrated roll, but not at the object.
    has_turned = jnp.asarray(np.cumsum(play.looks, axis=0) > 0)[phase]
    goals, _ = play.goals(script.replace(held=held, p=now.p), state)
    grasps = goals[np.argmax(play.looks, axis=0), np.arange(2)]
    is_about = jnp.linalg.norm(now.p - grasps, axis=-1) < ABOUT
    keeps = now.holds | has_turned | is_about
    normal = jnp.where(keeps[:, None], state.pose.R[:, :, 1], script.normal)
    script = script.replace(
        held=held, p=now.p, roll=now.roll, jaws=now.jaws, jaws_from=now.jaws, normal=normal
    )
    first = handover._enter(play, script, phase.astype(jnp.int32), state)
    after = jnp.minimum(first.phase + 1, len(play.duration) - 1)
    following = handover._enter(play, script, after, state)
    way = jnp.linalg.norm(first.goal - first.p, axis=-1)
    looks = jnp.asarray(play.looks)[first.phase]
    way = jnp.where(looks | ~looks.any(), way, 0.0).max()
    # The jaws' phases and the last one have no way, and last their time.
    stays = jnp.asarray(scripting.is_of_jaws(play.jaws))[phase] | (phase == len(play.duration) - 1)
    is_there = ~stays & (way < jnp.where(looks.any(), THERE, midway.ARRIVED))
    script = jax.tree.map(lambda a, b: jnp.where(is_there, a, b), following, first)
    return _moving(play, script, state)


def before_the_pass(
    play: handover.Play,
    phases: Sequence[str],
    script: handover.HandoverScript,
    state: EnvState,
    is_up: jax.Array,
    is_low: jax.Array,
) -> jax.Array:
    """Returns the phase, int32, while the taker does not hold the object.

    Args:
      play, phases: of the script.
      script: with the held part of the object.
      state: at the entry.
      is_up: the object is lifted.
      is_low: the giver is.
    """
    now = entry(state)
    goals, _ = play.goals(script.replace(p=now.p), state)
    above, down, close, lift, carry, near, meet, take = map(
        phases.index, ("above", "down", "close", "lift", "carry", "near", "meet", "take")
    )
    grasps = jnp.stack([goals[down, 0], goals[meet, 1]])
    off, starts = now.p - grasps, jnp.stack([goals[above, 0], goals[near, 1]]) - grasps
    is_coming = _is_above(off, starts, state) & (now.jaws > 0.0)
    is_about = jnp.linalg.norm(off, axis=-1) < ASIDE
    # Jaws that are sent to close, but have not yet, continue.
    is_shutting = (now.jaws <= -midway.OPEN) & ~state.touch & (state.gripper > EMPTY)
    is_closing = is_about & ((jnp.abs(now.jaws) < midway.OPEN) | is_shutting)
    is_slow = jnp.linalg.norm(state.velocity[0, :3]) < way_in.SLOW
    is_met = is_slow & (jnp.linalg.norm(goals[carry, 0] - now.p[0]) < MET)
    passed = jnp.where(is_coming[1], meet, near)
    passed = jnp.where(is_closing[1], take, passed)
    lifted = jnp.where(is_met, passed, carry)
    # Elsewhere a low giver closes and rises; with empty jaws it starts over from there.
    free = jnp.where(is_coming[0], down, jnp.where(is_low, lift, above))
    gives = now.holds[0]
    phase = jnp.where(gives & is_up, lifted, jnp.where(gives, lift, free))
    return jnp.where(is_closing[0] & ~is_up, close, phase).astype(jnp.int32)


def holders(now: Entry) -> jax.Array:
    """Returns `[2]` bool, the tools that hold; a taker counts once it has closed."""
    is_closing = now.holds[0] & (now.jaws[1] > -midway.OPEN)
    return now.holds & ~(is_closing & jnp.array([False, True]))


def missed(state: EnvState) -> jax.Array:
    """Returns True if the taker has closed without the object that the giver holds."""
    gives, takes = state.touch
    return gives & ~takes & (state.gripper_target[1] < 0.0) & (state.gripper[1] < EMPTY)


def _is_above(off: jax.Array, start: jax.Array, state: EnvState) -> jax.Array:
    """Returns True `[2]` for tips on the way down to their grasp, or about it.

    Args:
      off: `[2, 3]` m, the tips from their grasps.
      start: `[2, 3]` m from these, where the ways in begin.
      state: at this moment.
    """
    aside, out = (jnp.linalg.norm(x[:, :2], axis=-1) for x in (off, start))
    top = start[:, 2]
    is_within = (off[:, 2] > -way_in.BELOW) & (off[:, 2] < top + ASIDE)
    slope = jnp.maximum(out / top, way_in.SLOPE)
    is_between = aside < ASIDE + slope * jnp.maximum(off[:, 2], 0.0)
    return is_within & is_between & way_in.has_come(-off, top, state.velocity[:, :3])


def _moving(
    play: handover.Play, script: handover.HandoverScript, state: EnvState
) -> handover.HandoverScript:
    """Returns the script at the time at which its phase has the tools' speed."""
    way = script.goal - script.p
    aligned = jnp.asarray(play.aligned, jnp.float32)[script.phase]
    along = jnp.where(aligned < 1.0, way * jnp.array([0.0, 0.0, 1.0]), way)
    left = jnp.linalg.norm(along, axis=-1)
    # The tool with the longer way decides.
    arm = jnp.argmax(left)
    most = jnp.maximum(left[arm], midway.ARRIVED)
    is_still = left[arm] < midway.ARRIVED
    is_still |= jnp.asarray(scripting.is_of_jaws(play.jaws))[script.phase]
    speed = jnp.maximum(state.velocity[arm, :3] @ along[arm] / most, 0.0)
    at = midway.share(most, speed, script.duration, scripting.slope(script.duration))
    aside, roll, fraction = handover.progress(play, script, at)
    done = jnp.stack([aside, aside, fraction])
    start = script.goal - way / jnp.maximum(1.0 - done, jnp.array([midway.LEFT, midway.LEFT, 1e-6]))
    roll_from = script.roll_to - (script.roll_to - script.roll) / jnp.maximum(
        1.0 - roll, midway.LEFT
    )
    return script.replace(
        elapsed=jnp.where(is_still, 0.0, at * script.duration),
        start=jnp.where(is_still, script.start, start),
        roll_from=jnp.where(is_still, script.roll_from, roll_from),
    )
