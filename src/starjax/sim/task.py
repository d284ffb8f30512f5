"""Tasks: records of data and of pure, single-sample functions. Needs no simulator.

Shape letter A: the arms of the task. `Layout` and `Measurements` are the task's own pytrees.
"""

from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.core import registry
from starjax.core.types import Agent, ArrayTree, Pose
from starjax.sim.endoscope_camera import Endoscope

CONTROL_HZ = 30.0  # commands per second


class Field(NamedTuple):
    """Part of the `state` observation.

    Attributes:
      name: e.g. `needle.p`.
      size: number of entries.
      kind: `point` m in the world frame, scaled for networks; `rot6d`, `unit`: within [-1, 1].
    """

    name: str
    size: int
    kind: Literal["point", "rot6d", "unit"]


class Slot(NamedTuple):
    """Arm slot of a task.

    Attributes:
      workspace: name of the region of trocars and targets, which mounts are searched for.
      p_world_ref: `(3,)` m, nominal trocar o_ref.
      roll_zero: rad, see `rcm.TrocarFrame`.
      arm, tool: defaults.
    """

    workspace: str
    p_world_ref: tuple[float, float, float]
    roll_zero: float = 0.0
    arm: str = "fr5"
    tool: str = "grasper"


class TaskStatus(NamedTuple):
    """Progress of a task at one moment.

    Attributes:
      success_now: the strict conditions hold now; success is `settle_steps` such steps in a row.
      loose: a looser, published test holds now.
      lost: the episode cannot succeed any more (a drop that counts as a failure).
      stage: int32, index of `Task.stages`.
      reward: in [0, 1], grows with the stages and within them; 1 where `success_now`.
    """

    success_now: jax.Array
    loose: jax.Array
    lost: jax.Array
    stage: jax.Array
    reward: jax.Array


class TaskText(NamedTuple):
    """Phrases of a task for reports, without a capital or a full stop.

    Attributes:
      title: e.g. `needle pick`.
      done: completes "the policy ...", e.g. `lifted the needle`.
      strict: condition of strict success.
      loose: condition of the loose test.
      nearly: a failed trial that passed the loose test.
      collided: meaning of a collision.
      ground: surface below the tool, e.g. `the boards`.
      goal: the goal in an image, e.g. `the tip belongs at the coloured mark`.
      lost: condition of a lost trial; empty if none is.
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
      areas: closed polygons `[K, 3]`, filled and always in view.
      lines: open polylines `[K, 3]`, drawn over the areas.
      ground: m, height of the plane of a path's shadow.
    """

    areas: tuple[np.ndarray, ...]
    lines: tuple[np.ndarray, ...]
    ground: float = 0.0


class Contacts(NamedTuple):
    """Contacts C at one moment.

    Attributes:
      geom: `[C, 2]` int32 ids.
      dist: `[C]` m, negative for an overlap.
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


class StepReadings(NamedTuple):
    """Moving parts at the start of a physics step, for `Coupling.forces`.

    Attributes:
      qpos, qvel: generalised coordinates of the whole model, V velocities.
      pose: Pose `[A]`, the tips in the world.
      jacobian: `[A, 6, V]`, of the tips' velocity (m/s) and turn (rad/s) in the world.
      gripper: `[A]` in [-1, 1], commanded.
      timestep: s.
    """

    qpos: jax.Array
    qvel: jax.Array
    pose: Pose
    jacobian: jax.Array
    gripper: jax.Array
    timestep: float


class Coupling(NamedTuple):
    """Forces that a task computes itself in every physics step, added to those of contacts.

    Attributes:
      begin: (Bound, Layout, qpos, tips Pose `[A]`) -> qpos with objects that the tools hold, and
        the memory at reset, a pytree.
      forces: (Bound, Layout, memory, StepReadings) -> generalised forces `[V]`, memory.
    """

    begin: Callable[..., tuple[jax.Array, Any]]
    forces: Callable[..., tuple[jax.Array, Any]]


class SimReadings(NamedTuple):
    """Quantities of the simulation at one moment, for `Task.measure`.

    Attributes:
      qpos, qvel: generalised coordinates of the whole model.
      pose: Pose `[A]`, measured tips.
      velocity: `[A, 3]` m/s, of the tips over the last control step.
      opening: `[A]` in [-1, 1], of the jaws.
      touch: `[A]` bool, True if the jaws touch something graspable.
      contacts: of the last physics step.
      memory: of `Task.coupling`, None without one.
      collided: bool, a collision was found before; None in a check of the functions.
    """

    qpos: jax.Array
    qvel: jax.Array
    pose: Pose
    velocity: jax.Array
    opening: jax.Array
    touch: jax.Array
    contacts: Contacts
    memory: Any = None
    collided: jax.Array | None = None


def _no_obstacles(bound: Any, layout: ArrayTree, measurements: ArrayTree) -> Capsules:
    return Capsules(jnp.zeros((0, 3)), jnp.zeros((0, 3)), jnp.zeros(0))


class Task(NamedTuple):
    """Task, a row of the registry.

    Attributes:
      name: key in the registry.
      mjcf: the world: a part below `mjcf/`, or the path of a file.
      slots: one per arm.
      cameras: available names, of the MJCF or a tool; the first one is the default.
      time_limit_s: s of simulated time per trial.
      settle_steps: consecutive control steps with `success_now` for strict success.
      fields: parts of the `state` observation, in order.
      labels: names of integers that characterise an episode, e.g. `source`, `target`.
      stages: names, from the start to success.
      text: for reports.
      experts: variant -> scripted demonstrator, as `module:object` of an Agent or as `() -> Agent`;
        the first is the default. See `Task.expert`.
      graspable: geoms of the MJCF, by name, that jaws can hold.
      bind: (mj_model) -> Bound, ids resolved once.
      sample: (Bound, key) -> Layout, the draws at reset.
      tips: (Bound, Layout, trocars `[A, 3]` m) -> `[A, 3]` m, the tips' start.
      place_objects: (Bound, qpos, Layout) -> qpos with the task's objects in it.
      measure: (Bound, Layout, SimReadings, Measurements of the step before, None at reset) ->
        Measurements.
      status: (Bound, Layout, Measurements) -> TaskStatus.
      state: (Bound, Layout, Measurements) -> `[S]`, the fields one after another.
      relative: (state `[..., S]`, tips `[..., A, 3]` m) -> `[..., K]` of order one, differences
        that small networks compute too coarsely from `state`.
      label: (Layout) -> name of `labels` -> int32.
      colours: (Bound, Layout, rgb `[G, 3]`) -> `[G, 3]`, the goal marked.
      obstacles: (Bound, Layout, Measurements) -> Capsules that shafts may not enter.
      floor: m, the lowest height that jaws may reach.
      is_sound: (Bound, qpos, qvel) -> bool, False once an object has diverged.
      outline: (mj_model) -> Outline, for figures.
      trocars: configurations for training and evaluation, fields `[C, A]`; seen ones come first.
      is_seen: `[C]` bool.
      drive: (Bound, Layout, ctrl `[nu]`, s since reset) -> ctrl with targets of the task's own
        actuators, for objects that move by themselves.
      still: (Layout) -> Pose `[K]` of the MJCF's mocap bodies `still0`, .., visible without
        contacts, or None.
      least_steps: lower bound of the limit of a demonstration's control steps.
      stalled_s: s without a larger reward after which an episode is in trouble.
      thread: (Measurements) -> `[N, 3]` m, points of a thread, whose links are the MJCF's geoms
        `thread0`, ..; or None. See `addons.suture.thread`.
      coupling: forces of the task's own, or None.
      version: raised with a change of its starts, observation or judge; experts' results are found
        by `expert_version` too, which is raised with a change of any of its experts.
      endoscope: ranges of the camera `endoscope` in a trocar of its own, or None if `cameras` has
        no such one or a tool carries it.
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
    obstacles: Callable[..., Capsules] = _no_obstacles
    floor: float = 0.0
    is_sound: Callable[..., jax.Array] = lambda bound, qpos, qvel: jnp.ones((), bool)
    trocars: rcm.Trocar = rcm.Trocar(*(field[:, None] for field in rcm.TROCARS))
    is_seen: np.ndarray = rcm.IS_SEEN
    drive: Callable[..., jax.Array] = lambda bound, layout, ctrl, time: ctrl
    still: Callable[..., Pose] | None = None
    least_steps: int = 0
    stalled_s: float = 2.5
    thread: Callable[..., jax.Array] | None = None
    coupling: Coupling | None = None
    endoscope: Endoscope | None = None
    version: int = 1
    expert_version: int = 1

    @property
    def arms(self) -> int:
        """Number of arms A."""
        return len(self.slots)

    def expert(self, variant: str = "") -> Agent:
        """Returns a scripted demonstrator, the first one by default.

        An expert named as `module:object` is imported here: a task's module imports none.
        """
        expert = self.experts[variant or next(iter(self.experts))]
        return registry.load(expert) if isinstance(expert, str) else expert()

    @property
    def state_size(self) -> int:
        """Size S of the `state` observation."""
        return sum(field.size for field in self.fields)
