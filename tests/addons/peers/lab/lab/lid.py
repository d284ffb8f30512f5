"""Open a lid by its knob: an object on a hinge, grasped and moved along its arc."""

import pathlib
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from starjax.core.types import Agent, Command
from starjax.sim.task import CONTROL_HZ, Field, Outline, Slot, Task, TaskStatus, TaskText
from starjax.tasks import scripting

HINGE = jnp.array([-0.015, 0.0, 0.009])  # m
KNOB = (0.030, 0.007)  # m from the hinge, along and above the plate
AJAR = (0.0, 0.15)  # rad at the start
OPEN = 1.0  # rad
ARC_END = 1.15  # rad, of the expert
STILL = 0.3  # rad/s
HOVER = 0.015  # m above the knob
# s: to above the knob, down, close, along the arc.
TIMES = jnp.cumsum(jnp.array([1.0, 0.8, 0.3, 2.4]))


class Bound(NamedTuple):
    """Indices of the hinge in qpos and qvel, and the id of the knob's geom."""

    q: int
    dof: int
    knob: int


class Measurements(NamedTuple):
    """Angle (rad) and speed (rad/s) of the lid; True while the jaws touch the knob."""

    angle: jax.Array
    speed: jax.Array
    held: jax.Array


@flax.struct.dataclass
class Layout:
    """Angle at the start, rad."""

    ajar: jax.Array


class Script(NamedTuple):
    """Memory of the expert: its pace, the tip at the start, the angle at the grasp."""

    pace: jax.Array
    start: jax.Array
    angle: jax.Array


def knob_at(angle: jax.Array) -> jax.Array:
    """Returns the knob's place `[3]` m."""
    along, above = KNOB
    c, s = jnp.cos(angle), jnp.sin(angle)
    return HINGE + jnp.array([along * c - above * s, 0.0, along * s + above * c])


def bind(m: Any) -> Bound:
    joint = m.joint("hinge")
    return Bound(int(joint.qposadr[0]), int(joint.dofadr[0]), m.geom("knob").id)


def sample(bound: Bound, key: jax.Array) -> Layout:
    return Layout(jax.random.uniform(key, minval=AJAR[0], maxval=AJAR[1]))


def measure(bound: Bound, layout: Layout, readings: Any, before: Any) -> Measurements:
    return Measurements(readings.qpos[bound.q], readings.qvel[bound.dof], readings.touch[0])


def status(bound: Bound, layout: Layout, now: Measurements) -> TaskStatus:
    is_open = now.angle > OPEN
    good = is_open & now.held & (jnp.abs(now.speed) < STILL)
    stage = now.held.astype(jnp.int32) + (now.held & is_open)
    reward = jnp.where(good, 1.0, 0.9 * jnp.clip(now.angle / OPEN, 0.0, 1.0))
    return TaskStatus(good, is_open, jnp.zeros((), bool), stage, reward)


def state(bound: Bound, layout: Layout, now: Measurements) -> jax.Array:
    return jnp.append(knob_at(now.angle), now.angle / 2.0)


def init(key: jax.Array, state: Any) -> Script:
    pace = jax.random.uniform(key, minval=0.9, maxval=1.2)
    return Script(pace, state.pose.p[0], state.measurements.angle)


def act(script: Script, state: Any) -> tuple[Command, Script, Command]:
    """Follows the knob, which falls with the lid, then the knob's arc, by the clock."""
    time = script.pace * (state.step + 1) / CONTROL_HZ
    hover, down, close, arc = TIMES
    measured = state.measurements.angle
    script = script._replace(angle=jnp.where(time > close, script.angle, measured))
    knob = knob_at(script.angle)
    above = knob + jnp.array([0.0, 0.0, HOVER])

    def part(start: jax.Array, end: jax.Array) -> jax.Array:
        return scripting.sloped(jnp.clip((time - start) / (end - start), 0.0, 1.0))

    p = script.start + part(jnp.zeros(()), hover) * (above - script.start)
    p = p + part(hover, down) * (knob - above)
    angle = script.angle + part(close, arc) * (ARC_END - script.angle)
    p = jnp.where(time > close, knob_at(angle), p)
    jaws = scripting.jaws(jnp.ones(1), -jnp.ones(1), jnp.maximum(time - down, 0.0))
    command = scripting.command(jnp.zeros(1), p[None], jaws, state)
    return command, script, command


TASK = Task(
    name="lid",
    mjcf=str(pathlib.Path(__file__).with_name("lid.xml")),
    slots=(Slot(workspace="board", p_world_ref=(0.0, 0.0, 0.15)),),
    cameras=("front",),
    time_limit_s=8.0,
    settle_steps=15,
    fields=(Field("knob.p", 3, "point"), Field("lid.angle", 1, "unit")),
    stages=("away", "held", "open"),
    text=TaskText(
        title="lid",
        done="opened the lid",
        strict="open, held and still",
        loose="open",
        nearly="open, but not held and still",
        collided="touched the table with jaws, shaft or arm",
        ground="the table",
        goal="the lid belongs upright",
    ),
    experts={"default": lambda: Agent(init, act)},
    graspable=("knob",),
    bind=bind,
    sample=sample,
    tips=lambda bound, layout, p_trocars: jnp.array([[0.0, 0.0, 0.045]]),
    place_objects=lambda bound, qpos, layout: qpos.at[bound.q].set(layout.ajar),
    measure=measure,
    status=status,
    state=state,
    relative=lambda state, tips: (state[..., :3] - tips[..., 0, :]) / 0.03,
    is_sound=lambda bound, qpos, qvel: jnp.abs(qvel[bound.dof]) < 100.0,
    outline=lambda m: Outline((np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0]]) * 0.02,), ()),
)
