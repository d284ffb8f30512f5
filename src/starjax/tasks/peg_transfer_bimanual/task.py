"""Bimanual peg transfer, the exercise of FLS. Lengths in m.

One tool (arm 0) lifts the block, the other (arm 1) takes it in the air and threads it on the marked
peg. A drop is a failure.
"""

import flax.struct
import jax
import jax.numpy as jnp

from starjax.core.types import Pose
from starjax.sim import bodies, endoscope_camera, workspaces
from starjax.sim.task import SimReadings, TaskStatus
from starjax.tasks import rewards, two_arms
from starjax.tasks.peg_transfer import task as single
from starjax.tasks.peg_transfer import text

# Start of the tips, and waiting position of an idle one: the shafts lean apart.
PARK = ((-0.02, 0.0, 0.065), (0.02, 0.0, 0.065))
SPREAD = 0.008  # each axis, at most
DROPPED_STEPS = 15  # control steps without a tool after which a block that was lifted is dropped
STAGES = ("approach", "grasped", "lifted", "passed", "at the target", "threaded", "done")


@flax.struct.dataclass
class BimanualLayout:
    """Draws at reset, see `peg_transfer`; tips `[2, 3]` m."""

    source: jax.Array
    target: jax.Array
    target_peg: jax.Array
    block: Pose
    tips: jax.Array


@flax.struct.dataclass
class BimanualMeasurements:
    """Measurements of one moment and history of the episode.

    Attributes:
      block: pose_world_block.
      velocity: `[6]` of the block, m/s and rad/s.
      tips: `[2, 3]` m.
      touch: `[2]` bool, True if an arm's jaws touch the block.
      lifted: the block was lifted by arm 0.
      passed: it was then held by arm 1 alone in the air.
      untouched: int32, consecutive control steps without a tool at the block.
    """

    block: Pose
    velocity: jax.Array
    tips: jax.Array
    touch: jax.Array
    lifted: jax.Array
    passed: jax.Array
    untouched: jax.Array


def sample(bound: single.PegBound, key: jax.Array) -> BimanualLayout:
    """Draws as in `peg_transfer`, with two tips."""
    key_layout, key_tips = jax.random.split(key)
    drawn = single.sample(bound, key_layout)
    spread = jax.random.uniform(key_tips, (2, 3), minval=-SPREAD, maxval=SPREAD)
    tips = jnp.array(PARK) + spread
    return BimanualLayout(drawn.source, drawn.target, drawn.target_peg, drawn.block, tips)


def measure(
    bound: single.PegBound,
    layout: BimanualLayout,
    readings: SimReadings,
    before: BimanualMeasurements | None,
) -> BimanualMeasurements:
    """Measures the block, the jaws, and its holders."""
    block = bodies.free_pose(readings.qpos, bound.block)
    touch = readings.touch
    in_air = block.p[2] > single.RIM_HEIGHT + single.LIFTED  # higher than it stands
    lifted, passed = in_air & touch[0] & ~touch[1], jnp.zeros((), bool)
    untouched = jnp.zeros((), jnp.int32)
    if before is not None:
        lifted = before.lifted | lifted
        # On the board it could be put down by one tool and picked up by the other.
        passed = before.passed | (before.lifted & in_air & touch[1] & ~touch[0])
        untouched = jnp.where(touch.any(), 0, before.untouched + 1)
    return BimanualMeasurements(
        block=block,
        velocity=readings.qvel[bound.block_dof : bound.block_dof + 6],
        tips=readings.pose.p,
        touch=touch,
        lifted=lifted,
        passed=passed,
        untouched=untouched,
    )


def status(
    bound: single.PegBound, layout: BimanualLayout, measurements: BimanualMeasurements
) -> TaskStatus:
    """Tests strict success (passed in the air, threaded, released, at rest) and SurRoL's test."""
    block, peg = measurements.block, layout.target_peg
    threaded, near = single.is_threaded(block, peg), single.is_near(block, peg)
    is_left = single.is_at_rest(measurements.velocity) & ~measurements.touch.any()
    success_now = threaded & measurements.passed & is_left
    lost = measurements.lifted & (measurements.untouched > DROPPED_STEPS) & ~threaded  # dropped
    lifted, passed = measurements.lifted, measurements.passed
    stage = rewards.last_reached(
        measurements.touch[0], lifted, passed, passed & near, passed & threaded, success_now
    )
    to_giver, to_taker = jnp.linalg.norm(block.p - measurements.tips, axis=-1)
    terms = {
        "approach": rewards.nearness(to_giver, single.NEAR),
        "lifted": rewards.nearness(to_taker, single.NEAR),
        "passed": rewards.nearness(jnp.linalg.norm(block.p[:2] - peg), single.NEAR),
    }
    reward = rewards.staged(STAGES, terms, stage, success_now)
    return TaskStatus(success_now, near, lost, stage, reward)


def relative(state: jax.Array, tips: jax.Array) -> jax.Array:
    """Returns `[..., 21]`: as in `peg_transfer` from each tip, and from tip to tip."""
    parts = [single.relative(state, tips[..., a : a + 1, :]) for a in range(2)]
    return jnp.concatenate([*parts, (tips[..., 1, :] - tips[..., 0, :]) / single.NEAR], axis=-1)


TEXT = text.TEXT._replace(
    title="bimanual peg transfer",
    done="handed the block over in the air and put it on its peg",
    strict="lifted by one tool, passed in the air, threaded on the target peg by the other, "
    "released and at rest, in time",
    nearly="block at its peg, but not passed in the air, or not threaded, released and at rest",
    collided="touched the board, a peg or the block with a shaft or an arm, or the arms met",
    lost="the block was dropped",
)


TASK = single.TASK._replace(
    name="peg_transfer_bimanual",
    mjcf="tasks/peg_transfer_bimanual/peg_transfer_bimanual.xml",
    slots=two_arms.SLOTS,
    cameras=("side", endoscope_camera.NAME),
    stages=STAGES,
    text=TEXT,
    expert_version=3,
    experts={"default": "starjax.tasks.peg_transfer_bimanual.expert:AGENT"},
    sample=sample,
    tips=lambda bound, layout, p_trocars: layout.tips,
    measure=measure,
    status=status,
    relative=relative,
    endoscope=workspaces.SIDE_ENDOSCOPE,
    trocars=two_arms.TROCARS,
)
