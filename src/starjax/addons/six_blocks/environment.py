"""Six blocks in one episode: the environment of one block's transfer, restarted for each block.

A block that is threaded, released and at rest stays in place, and the next one follows. In between
a script withdraws the tools to an episode's start, which counts as time. Physics, success test and
agent are those of one block's transfer.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.addons.six_blocks import task as six
from starjax.core.types import Agent, Command, Pose
from starjax.sim import env as envs
from starjax.sim import physics
from starjax.sim.scene import Scene
from starjax.sim.state import Env, EnvState
from starjax.sim.task import SimReadings
from starjax.tasks.peg_transfer_bimanual import task

# Control steps of the script: the tips rise, then go to their start.
RISE, WITHDRAWN = 18, 45
HEIGHT = 0.045  # m to which they rise: over blocks that stand


def make(arms: Sequence[str] = (), tools: Sequence[str] = (), **options: Any) -> Env:
    """Builds the exercise, `options` as of `sim.env.make`. Its label `moved` counts blocks."""
    return wrap(envs.make(six.TASK.name, arms, tools, variant=six.TASK, **options))


def wrap(env: Env) -> Env:
    """Wraps an environment of `six.TASK` into the exercise."""

    def step(state: EnvState, command: Command) -> EnvState:
        layout = state.layout
        between = (layout.turn > 0) & (state.step < layout.since + WITHDRAWN)
        command = jax.tree.map(
            lambda own, other: jnp.where(between, own, other), _withdrawing(state), command
        )
        after = env.step(state, command)
        continues = after.success & ~state.done & (state.layout.turn < six.BLOCKS - 1)
        following = _next(env.scene, after)
        return jax.tree.map(lambda x, y: jnp.where(continues, x, y), following, after)

    def labels(state: EnvState) -> dict[str, jax.Array]:
        return {"moved": state.layout.turn + state.success}

    return env._replace(step=step, labels=labels)


def reset_each_block(agent: Agent) -> Agent:
    """Returns the agent with its memory reset for every block."""

    def init(key: jax.Array, state: EnvState) -> tuple:
        return key, agent.init(key, state)

    def act(memory: tuple, state: EnvState) -> tuple[Command, tuple, Command]:
        key, inner = memory
        turn, since = state.layout.turn, state.layout.since
        fresh = agent.init(jax.random.fold_in(key, turn), state)
        begins = (turn > 0) & (state.step == since + WITHDRAWN)
        inner = jax.tree.map(lambda x, y: jnp.where(begins, x, y), fresh, inner)
        command, inner, label = agent.act(inner, state)
        return command, (key, inner), label

    return Agent(init, act)


def _withdrawing(state: EnvState) -> Command:
    """Returns a command: jaws open, tips straight up, then to their start at roll 0."""
    rises = state.step < state.layout.since + RISE
    left = state.layout.tips
    up = left.at[:, 2].set(jnp.maximum(left[:, 2], HEIGHT))
    p = jnp.where(rises, up, jnp.array(task.PARK))
    with jax.default_matmul_precision("highest"):
        roll = rcm.ACTION_SPACES["rcm4"].encode(state.pose, state.measured_trocar)[:, :1]
        pose, _ = rcm.ACTION_SPACES["rcm4"].decode(
            jnp.concatenate([jnp.where(rises, roll, 0.0), p], axis=-1), state.measured_trocar
        )
    return Command(pose, jnp.ones(len(p)))


def _next(scene: Scene, state: EnvState) -> EnvState:
    """Leaves the present block in place and starts the next one, without moving the arms."""
    bound = scene.bound
    layout = six.put(state.layout, Pose(state.measurements.block.R, state.measurements.block.p))
    turn = jnp.minimum(layout.turn + 1, six.BLOCKS - 1)
    layout = six.begin(bound, layout, turn, state.pose.p, state.step)
    own = slice(bound.block_dof, bound.block_dof + 6)
    after = physics.PhysicsState(
        qpos=scene.task.place_objects(bound, state.physics.qpos, layout),
        qvel=state.physics.qvel.at[own].set(0.0),
        qacc_warmstart=state.physics.qacc_warmstart.at[own].set(0.0),
    )
    touch, still = jnp.zeros_like(state.touch), jnp.zeros_like(state.pose.p)
    contacts = physics.no_contacts(scene)
    readings = SimReadings(
        after.qpos, after.qvel, state.pose, still, state.gripper, touch, contacts
    )
    no = jnp.zeros((), bool)
    return state.replace(
        physics=after,
        layout=layout,
        measurements=scene.task.measure(bound, layout, readings, None),
        settled=jnp.zeros((), jnp.int32),
        stage=jnp.zeros((), jnp.int32),
        touch=touch,
        done=no,
        success=no,
    )
