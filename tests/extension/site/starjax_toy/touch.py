"""Touch a mark and rest: a whole task in a file."""

import pathlib
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.core.types import Agent, Command
from starjax.sim.task import Field, Outline, Slot, Task, TaskStatus, TaskText

MARKS = 4
CLOSE = 0.003  # m
STEP = 0.003  # m a control step, of the expert


@flax.struct.dataclass
class Layout:
    goal: jax.Array  # int32
    p: jax.Array  # [3] m, of the goal


def bind(m: Any) -> np.ndarray:
    return np.array([m.geom(f"mark{i}").id for i in range(MARKS)]), np.array(
        [m.geom(f"mark{i}").pos for i in range(MARKS)], np.float32
    )


def sample(bound: Any, key: jax.Array) -> Layout:
    goal = jax.random.randint(key, (), 0, MARKS)
    return Layout(goal, jnp.asarray(bound[1])[goal])


def status(bound: Any, layout: Layout, tip: jax.Array) -> TaskStatus:
    off = jnp.linalg.norm(tip - layout.p)
    close, no = off < CLOSE, jnp.zeros((), bool)
    return TaskStatus(close, close, no, close.astype(jnp.int32), jnp.exp(-off / 0.03))


def act(memory: jax.Array, state: Any) -> tuple[Command, jax.Array, Command]:
    tip, frame = state.pose.p, state.measured_trocar
    way = state.layout.p - tip[0]
    p = tip[0] + way * jnp.minimum(1.0, STEP / jnp.maximum(jnp.linalg.norm(way), 1e-9))
    pose, _ = rcm.ACTION_SPACES["rcm4"].decode(jnp.append(0.0, p)[None], frame)
    command = Command(pose, jnp.ones(1))
    return command, memory, command


TASK = Task(
    name="touch",
    mjcf=str(pathlib.Path(__file__).with_name("touch.xml")),
    slots=(Slot(workspace="board", p_world_ref=(0.0, 0.0, 0.15)),),
    cameras=("front",),
    time_limit_s=5.0,
    settle_steps=10,
    fields=(Field("goal.p", 3, "point"),),
    labels=("goal",),
    stages=("away", "close"),
    text=TaskText(
        title="touch",
        done="touched the mark",
        strict="at the mark and at rest",
        loose="close to the mark",
        nearly="close to the mark, but not at rest",
        collided="hit the table",
        ground="the table",
        goal="the coloured mark is the goal",
    ),
    experts={"default": lambda: Agent(lambda key, state: key, act)},
    graspable=(),
    bind=bind,
    sample=sample,
    tips=lambda bound, layout, p_trocars: jnp.array([[0.0, 0.0, 0.05]]),
    measure=lambda bound, layout, readings, before: readings.pose.p[0],
    status=status,
    state=lambda bound, layout, tip: layout.p,
    relative=lambda state, tips: (state - tips[..., 0, :]) / 0.03,
    label=lambda layout: {"goal": layout.goal},
    colours=lambda bound, layout, rgb: rgb.at[jnp.asarray(bound[0])[layout.goal]].set(1.0),
    outline=lambda m: Outline((np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0]]) * 0.05,), ()),
)
