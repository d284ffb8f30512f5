"""Needle hand-over: one tool (arm 0) picks a suture needle up, the other (arm 1) takes it over.

A drop is a failure. Needle and foam are those of needle pick. Lengths in m.
"""

import flax.struct
import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.core.types import Pose
from starjax.sim import bodies, endoscope_camera, workspaces
from starjax.sim.task import SimReadings, TaskStatus
from starjax.tasks import rewards, two_arms
from starjax.tasks.needle_pick import task as single

# Start of the tips, and waiting position of an idle one: near the middle, so the shafts lean apart.
PARK = ((-0.012, 0.0, 0.065), (0.012, 0.0, 0.065))
SPREAD = 0.005  # each axis, at most
# Mean position of the needle: on the side of the tool that picks it up.
PLACE = (-0.024, 0.0)
PLACE_SPREAD = (0.012, 0.02)  # either way

DROPPED_STEPS = 15  # control steps without a tool after which a needle that was lifted is dropped
STAGES = ("approach", "grasped", "lifted", "taken over", "held", "done")


@flax.struct.dataclass
class HandoverLayout:
    """Draws at reset: pose_world_needle; tips `[2, 3]` m."""

    needle: Pose
    tips: jax.Array


@flax.struct.dataclass
class HandoverMeasurements:
    """Measurements of one moment and history of the episode.

    Attributes:
      needle: pose_world_needle.
      tips: `[2, 3]` m.
      touch: `[2]` bool, True if an arm's jaws hold the wire.
      lifted: the needle was lifted by arm 0 alone.
      passed: after that it was held by arm 1 alone in the air.
      grip: `[3]` m, tip 1 in the needle's frame at the start of its present hold alone.
      slip: m, the tip's distance from `grip`.
      untouched: int32, consecutive control steps without a tool at the needle.
    """

    needle: Pose
    tips: jax.Array
    touch: jax.Array
    lifted: jax.Array
    passed: jax.Array
    grip: jax.Array
    slip: jax.Array
    untouched: jax.Array


def sample(bound: single.NeedleBound, key: jax.Array) -> HandoverLayout:
    """Draws the needle's position and yaw, and the tips' start."""
    key_place, key_yaw, key_tips = jax.random.split(key, 3)
    aside = jax.random.uniform(key_place, (2,), minval=-1.0) * jnp.array(PLACE_SPREAD)
    yaw = jax.random.uniform(key_yaw, minval=-jnp.pi, maxval=jnp.pi)
    needle = Pose(rcm.rotation_z(yaw), jnp.append(jnp.array(PLACE) + aside, bound.height))
    spread = jax.random.uniform(key_tips, (2, 3), minval=-SPREAD, maxval=SPREAD)
    return HandoverLayout(needle, jnp.array(PARK) + spread)


def measure(
    bound: single.NeedleBound,
    layout: HandoverLayout,
    readings: SimReadings,
    before: HandoverMeasurements | None,
) -> HandoverMeasurements:
    """Measures the needle, its holders, and its slip in the taker's jaws."""
    needle, touch = bodies.free_pose(readings.qpos, bound.needle), readings.touch
    is_up = needle.p[2] > bound.height + single.LIFT
    lifted, passed = is_up & touch[0] & ~touch[1], jnp.zeros((), bool)
    here = needle.R.T @ (readings.pose.p[1] - needle.p)  # taker's tip in the needle's frame
    grip, untouched = here, jnp.zeros((), jnp.int32)
    if before is not None:
        is_alone = touch[1] & ~touch[0]
        lifted = before.lifted | lifted
        # Only after the giver has held it alone in the air: a needle that is picked up by the
        # taker is not handed over.
        passed = before.passed | (before.lifted & is_up & is_alone)
        was_alone = before.touch[1] & ~before.touch[0]
        # A hold restarts once the needle has slipped too far.
        goes_on = is_alone & was_alone & (before.slip < single.SLIP)
        grip = jnp.where(goes_on, before.grip, here)
        untouched = jnp.where(touch.any(), 0, before.untouched + 1)
    return HandoverMeasurements(
        needle=needle,
        tips=readings.pose.p,
        touch=touch,
        lifted=lifted,
        passed=passed,
        grip=grip,
        slip=jnp.linalg.norm(here - grip),  # m since the hold began
        untouched=untouched,
    )


def status(
    bound: single.NeedleBound, layout: HandoverLayout, measurements: HandoverMeasurements
) -> TaskStatus:
    """Tests strict success (taken over, held alone without slip) and loose success (taken over)."""
    is_up = measurements.needle.p[2] > bound.height + single.LIFT
    is_alone = measurements.touch[1] & ~measurements.touch[0]
    success_now = measurements.passed & is_up & is_alone & (measurements.slip < single.SLIP)
    lost = measurements.lifted & (measurements.untouched > DROPPED_STEPS)
    stage = rewards.last_reached(
        measurements.touch[0], measurements.lifted, measurements.passed, success_now
    )
    to_giver, to_taker = jnp.linalg.norm(measurements.needle.p - measurements.tips, axis=-1)
    terms = {
        "approach": rewards.nearness(to_giver, single.NEAR),
        "lifted": rewards.nearness(to_taker, single.NEAR),
    }
    reward = rewards.staged(STAGES, terms, stage, success_now)
    return TaskStatus(success_now, measurements.passed, lost, stage, reward)


def relative(state: jax.Array, tips: jax.Array) -> jax.Array:
    """Returns `[..., 15]`: as in `needle_pick` from each tip, and from tip to tip."""
    parts = [single.relative(state, tips[..., a : a + 1, :]) for a in range(2)]
    return jnp.concatenate([*parts, (tips[..., 1, :] - tips[..., 0, :]) / single.NEAR], axis=-1)


TEXT = single.TEXT._replace(
    title="needle hand-over",
    done="handed the needle over in the air",
    strict="lifted by one tool, taken over in the air, and held for 2 s by the other alone without "
    "slipping by more than 0.5 mm, in time",
    loose="the other tool alone held the needle in the air, slipping or not",
    nearly="needle taken over, but it slipped or was not held for 2 s",
    collided="pressed jaws or shaft into the foam, or shafts or arms touched",
    goal="the needle must be handed over",
    lost="the needle was dropped",
)


TASK = single.TASK._replace(
    name="needle_handover",
    mjcf="tasks/needle_handover/needle_handover.xml",
    slots=two_arms.SLOTS,
    cameras=("side", endoscope_camera.NAME),
    time_limit_s=60.0,
    stages=STAGES,
    text=TEXT,
    expert_version=3,
    experts={
        "default": "starjax.tasks.needle_handover.expert:AGENT",
        "wrist": "starjax.tasks.needle_handover.expert_wrist:AGENT",
    },
    sample=sample,
    tips=lambda bound, layout, p_trocars: layout.tips,
    measure=measure,
    status=status,
    relative=relative,
    # Between the needle's start and the hand-over.
    endoscope=workspaces.SIDE_ENDOSCOPE._replace(work=(-0.012, 0.0, 0.02)),
    trocars=two_arms.TROCARS,
)
