"""Reach: the tip goes to the marked point and rests there. Lengths in m."""

from typing import TYPE_CHECKING, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from starjax.sim import endoscope_camera, workspaces
from starjax.sim.task import Capsules, Field, Outline, SimReadings, Slot, Task, TaskStatus, TaskText
from starjax.tasks import outlines, rewards

if TYPE_CHECKING:  # a robot loads tasks without the simulator
    import mujoco

# Where an episode begins.
TIP_HOME = (0.0, 0.0, 0.06)
TIP_SPREAD = 0.015  # each axis, at most

# Strict success: within TOLERANCE and slower than REST_SPEED for SETTLE_STEPS control steps (1 s).
TOLERANCE = 0.002
REST_SPEED = 0.005  # m/s
SETTLE_STEPS = 30
LOOSE = 0.005  # m from the mark, moving or not: the usual test of surgical suites

STAGES = ("far", "near", "at the mark", "done")
NEAR = 0.03  # m, scale of distances in rewards and features
MARK_RGB = (0.98, 0.62, 0.1)


@flax.struct.dataclass
class ReachLayout:
    """Draws at reset.

    Attributes:
      goal: `[]` int32, number of the mark.
      p: `[3]` m, its position.
      tip: `[3]` m, the tip's start.
    """

    goal: jax.Array
    p: jax.Array
    tip: jax.Array


@flax.struct.dataclass
class ReachMeasurements:
    """Measurements of one moment: the tip `[3]` m, and its speed in m/s."""

    tip: jax.Array
    speed: jax.Array


class ReachBound(NamedTuple):
    """Ids in the compiled model.

    Attributes:
      geoms: `[M]` geom ids of the marks.
      marks: `[M, 3]` m, their positions.
      posts: `[M]` m, radii of the posts.
    """

    geoms: np.ndarray
    marks: np.ndarray
    posts: np.ndarray


def bind(m: "mujoco.MjModel") -> ReachBound:
    """Resolves the ids of marks and posts."""
    count = sum(m.geom(g).name.startswith("mark") for g in range(m.ngeom))
    geoms = np.array([m.geom(f"mark{i}").id for i in range(count)])
    posts = np.array([m.geom(f"post{i}").size[0] for i in range(count)], np.float32)
    return ReachBound(geoms, np.array(m.geom_pos[geoms], np.float32), posts)


def sample(bound: ReachBound, key: jax.Array) -> ReachLayout:
    """Draws the mark and the tip's start."""
    key_goal, key_tip = jax.random.split(key)
    goal = jax.random.randint(key_goal, (), 0, len(bound.marks))
    spread = jax.random.uniform(key_tip, (3,), minval=-TIP_SPREAD, maxval=TIP_SPREAD)
    return ReachLayout(goal, jnp.asarray(bound.marks)[goal], jnp.array(TIP_HOME) + spread)


def measure(
    bound: ReachBound, layout: ReachLayout, readings: SimReadings, before: ReachMeasurements | None
) -> ReachMeasurements:
    """Measures the tip and its speed."""
    return ReachMeasurements(readings.pose.p[0], jnp.linalg.norm(readings.velocity[0]))


def status(bound: ReachBound, layout: ReachLayout, measurements: ReachMeasurements) -> TaskStatus:
    """Tests strict success (at the mark and at rest) and loose success (near it)."""
    off = jnp.linalg.norm(measurements.tip - layout.p)
    at_mark, near = off < TOLERANCE, off < LOOSE
    success_now = at_mark & (measurements.speed < REST_SPEED)
    # Nested conditions: their number is the stage
    stage = near.astype(jnp.int32) + at_mark + success_now
    terms = {STAGES[0]: rewards.nearness(off, NEAR)}
    reward = rewards.staged(STAGES, terms, stage, success_now)
    return TaskStatus(success_now, near, jnp.zeros((), bool), stage, reward)


def colours(bound: ReachBound, layout: ReachLayout, rgb: jax.Array) -> jax.Array:
    """Marks the goal."""
    return rgb.at[jnp.asarray(bound.geoms)[layout.goal]].set(jnp.array(MARK_RGB))


def obstacles(bound: ReachBound, layout: ReachLayout, measurements: ReachMeasurements) -> Capsules:
    """Returns the posts below the marks."""
    marks = jnp.asarray(bound.marks)
    foot = marks.at[:, 2].set(0.0)
    return Capsules(foot, marks - jnp.array([0.0, 0.0, TOLERANCE]), jnp.asarray(bound.posts))


TEXT = TaskText(
    title="reach",
    done="brought the tip to the marked point",
    strict="within 2 mm of the marked point and at rest for 1 s, in time",
    loose="the tip was within 5 mm of the marked point, moving or not",
    nearly="near the marked point, but not at rest on it",
    collided="touched the pad, or a post with the shaft",
    ground="the pad",
    goal="the tip belongs on the coloured mark",
)


def outline(m: "mujoco.MjModel") -> Outline:
    """Returns the pad's rectangle and the posts."""
    marks = [mark.pos for mark in outlines.named(m, "mark")]
    lines = tuple(outlines.stick(mark, mark[2]) for mark in marks)
    return Outline((outlines.rectangle(m, "pad"),), lines)


TASK = Task(
    name="reach",
    mjcf="tasks/reach/reach.xml",
    slots=(Slot(workspace="board", p_world_ref=(0.0, 0.0, 0.15)),),
    cameras=("camera", endoscope_camera.NAME),
    time_limit_s=15.0,
    settle_steps=SETTLE_STEPS,
    fields=(Field("goal.p", 3, "point"),),
    labels=("goal",),
    stages=STAGES,
    text=TEXT,
    expert_version=2,
    experts={"default": "starjax.tasks.reach.expert:AGENT"},
    graspable=(),
    bind=bind,
    sample=sample,
    tips=lambda bound, layout, p_trocars: layout.tip[None],
    measure=measure,
    status=status,
    state=lambda bound, layout, measurements: layout.p,
    relative=lambda state, tips: (state - tips[..., 0, :]) / NEAR,
    label=lambda layout: {"goal": layout.goal},
    colours=colours,
    obstacles=obstacles,
    outline=outline,
    endoscope=workspaces.BOARD_ENDOSCOPE,
)
