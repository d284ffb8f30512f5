"""Tasks: records of data and of pure, single-sample functions. Needs no simulator.

Shape letter A: the arms of the task. `Layout` and `Measurements` are the task's own pytrees.
"""

from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm, registry
from starjax.sim.endoscope_camera import Endoscope
from starjax.types import Agent, Pose

CONTROL_HZ = 30.0  # commands a second


class Field(NamedTuple):
    """A part of the `state` observation.

    Attributes:
      name: what it is, e.g. `needle.p`.
      size: how many numbers.
      kind: `point` m in the world frame, scaled for networks; `rot6d`, `unit`: within [-1, 1].
    """

    name: str
    size: int
    kind: Literal["point", "rot6d", "unit"]


class Slot(NamedTuple):
    """Where one arm of a task works.

    Attributes:
      workspace: names the region of trocars and targets; mounts are found for a workspace.
      p_world_ref: `(3,)` m, nominal trocar o_ref.
      roll_zero: rad, see `rcm.TrocarFrame`.
      arm, tool: used unless the user chooses others.
    """

    workspace: str
    p_world_ref: tuple[float, float, float]
    roll_zero: float = 0.0
    arm: str = "fr5"
    tool: str = "grasper"


class TaskStatus(NamedTuple):
    """A task's judgement of one moment.

    Attributes:
      success_now: the strict conditions hold now; success is `settle_steps` such steps in a row.
      loose: a looser published test holds now.
      lost: the episode cannot succeed any more (a drop that counts as a failure).
      stage: int32, how far the task is: an index of `Task.stages`.
      reward: in [0, 1], grows with the stages and within them; 1 where `success_now`.
    """

    success_now: jax.Array
    loose: jax.Array
    lost: jax.Array
    stage: jax.Array
    reward: jax.Array


class TaskText(NamedTuple):
    """Phrases for reports of a task, in plain English, without a capital or a full stop.

    Attributes:
      title: e.g. `needle pick`.
      done: completes "the policy ...", e.g. `lifted the needle`.
      strict: when a trial is a strict success.
      loose: when it passes the loose test.
      nearly: a failed trial that passed the loose test.
      collided: what a collision is here.
      ground: what the tool works over, e.g. `the boards`.
      goal: how a picture shows what is asked for, e.g. `the tip belongs at the coloured mark`.
      lost: what makes a trial hopeless before its time is up; empty where nothing does.
    """

    title: str
    done: str
    strict: str
    loose: str
    nearly: str
    collided: str
    ground: str
    goal: str
    lost: str = ""


class Outline(NamedTuple):
    """Fixed parts of a task, for line drawings. Points are m in the world frame.

    Attributes:
      areas: closed polygons `[K, 3]`, filled; a drawing shows all of them.
      lines: open polylines `[K, 3]`, drawn over the areas.
      ground: m, height of the plane on which a path's shadow lies.
    """

    areas: tuple[np.ndarray, ...]
    lines: tuple[np.ndarray, ...]
    ground: float = 0.0


class Contacts(NamedTuple):
    """Contacts C of one moment.

    Attributes:
      geom: `[C, 2]` int32 ids.
      dist: `[C]` m, negative where the two overlap.
    """

    geom: jax.Array
    dist: jax.Array


class Capsules(NamedTuple):
    """Obstacles K, in the world.

    Attributes:
      start, end: `[K, 3]` m, of the axis.
      radius: `[K]` m.
    """

    start: jax.Array
    end: jax.Array
    radius: jax.Array


class SimReadings(NamedTuple):
    """Measurements of one moment that a task may use.

    Attributes:
      qpos, qvel: generalised coordinates of the whole model.
      pose: measured tips, Pose `[A]`, and `opening`: `[A]` in [-1, 1].
      velocity: `[A, 3]` m/s, of the tips over the last control step.
      touch: `[A]` bool, whether the jaws touch something that they can grasp.
      contacts: of the last physics step.
    """

    qpos: jax.Array
    qvel: jax.Array
    pose: Pose
    velocity: jax.Array
    opening: jax.Array
    touch: jax.Array
    contacts: Contacts


NO_CAPSULES = Capsules(*(np.zeros(shape, np.float32) for shape in ((0, 3), (0, 3), 0)))


class Task(NamedTuple):
    """One task, a row of the registry.

    Attributes:
      name: key in the registry.
      mjcf: the world: a part below `mjcf/`, or the path of a file.
      slots: one for each arm.
      cameras: of the MJCF or of a tool, that policies may see; the first one is used unless others
        are chosen.
      time_limit_s: s of simulated time that a trial may take.
      settle_steps: control steps in a row that a strict success must hold.
      fields: parts of the `state` observation, in order.
      labels: names of the whole numbers that tell episodes apart, e.g. `source`, `target`.
      stages: names, from the start to success.
      text: for reports.
      experts: variant -> scripted demonstrator, as `module:object` of an Agent or as `() -> Agent`;
        the first is the default. See `Task.expert`.
      graspable: geoms of the MJCF, by name, that jaws can hold.
      bind: (mj_model) -> Bound, ids resolved once.
      sample: (Bound, key) -> Layout, what is drawn at reset.
      tips: (Bound, Layout, trocars `[A, 3]` m) -> `[A, 3]` m, where the tools' tips start.
      place_objects: (Bound, qpos, Layout) -> qpos with the task's objects in it.
      measure: (Bound, Layout, SimReadings, Measurements of the step before, None at reset) ->
        Measurements.
      status: (Bound, Layout, Measurements) -> TaskStatus.
      state: (Bound, Layout, Measurements) -> `[S]`, the fields one after another.
      relative: (state `[..., S]`, tips `[..., A, 3]` m) -> `[..., K]` of order one: differences
        that small networks would not get exactly enough from `state`.
      label: (Layout) -> name of `labels` -> int32.
      colours: (Bound, Layout, rgb `[G, 3]`) -> `[G, 3]`, the goal marked.
      obstacles: (Bound, Layout, Measurements) -> Capsules that shafts may not enter, see
        `sim.collision`.
      floor: m, the lowest height that jaws may reach.
      is_sound: (Bound, qpos, qvel) -> bool, False once an object has diverged.
      outline: (mj_model) -> Outline, for figures.
      trocars: configurations of trocars to train and to be scored on, fields `[C, A]`; the seen
        ones, of which the first may be chosen for training, come first.
      is_seen: `[C]` bool.
      drive: (Bound, Layout, ctrl `[nu]`, s since reset) -> ctrl with what actuators of the task's
        own MJCF are to do, for things that move by themselves.
      still: (Layout) -> Pose `[K]` of the mocap bodies `still0`, .. of the MJCF, which are seen and
        touch nothing; None if there are none.
      least_steps: control steps that any success takes; demonstrations may take so many whatever
        the usual limit is.
      endoscope: of the camera `endoscope`, where the task can be seen through one that is held in a
        trocar of its own; None where no such camera is among `cameras`, or a tool carries it.
    """

    name: str
    mjcf: str
    slots: tuple[Slot, ...]
    cameras: tuple[str, ...]
    time_limit_s: float
    settle_steps: int
    fields: tuple[Field, ...]
    stages: tuple[str, ...]
    text: TaskText
    experts: Mapping[str, str | Callable[[], Agent]]
    graspable: tuple[str, ...]
    bind: Callable[..., Any]
    sample: Callable[..., Any]
    tips: Callable[..., jax.Array]
    measure: Callable[..., Any]
    status: Callable[..., TaskStatus]
    state: Callable[..., jax.Array]
    relative: Callable[..., jax.Array]
    outline: Callable[..., Outline]
    labels: tuple[str, ...] = ()
    label: Callable[..., dict[str, jax.Array]] = lambda layout: {}
    place_objects: Callable[..., jax.Array] = lambda bound, qpos, layout: qpos
    colours: Callable[..., jax.Array] = lambda bound, layout, rgb: rgb
    obstacles: Callable[..., Capsules] = lambda bound, layout, measurements: NO_CAPSULES
    floor: float = 0.0
    is_sound: Callable[..., jax.Array] = lambda bound, qpos, qvel: jnp.ones((), bool)
    trocars: rcm.Trocar = rcm.Trocar(*(field[:, None] for field in rcm.TROCARS))
    is_seen: np.ndarray = rcm.IS_SEEN
    drive: Callable[..., jax.Array] = lambda bound, layout, ctrl, time: ctrl
    still: Callable[..., Pose] | None = None
    least_steps: int = 0
    endoscope: Endoscope | None = None

    @property
    def arms(self) -> int:
        """A."""
        return len(self.slots)

    def expert(self, variant: str = "") -> Agent:
        """Returns a scripted demonstrator, the first one by default.

        An expert named as `module:object` is imported here, so that importing a task does not.
        """
        expert = self.experts[variant or next(iter(self.experts))]
        return registry.load(expert) if isinstance(expert, str) else expert()

    @property
    def state_size(self) -> int:
        """S."""
        return sum(field.size for field in self.fields)
