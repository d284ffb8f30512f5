"""Compiled closed loops of one episode with an expert or a policy, whose trocars can be moved.

While no trocar is moved this is the loop of `rollouts.engine`: seed, trocar and number of a trial
give the same episode here and in an evaluation, except for the last bits of another program.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax.addons.viewer.frame import Frame
from starjax.core import methods
from starjax.policies import in_env, packaged
from starjax.policies.monitor.record import Monitor
from starjax.rcm.trocar import Trocar
from starjax.runtime.precompile import Program
from starjax.sim import env as sim_env
from starjax.sim import moving_trocars, registries
from starjax.sim.rollouts import agent as agents
from starjax.sim.rollouts import trial_key
from starjax.sim.state import EnvState

EXPERT = "expert"
# m/s at which a trocar follows its handle: tissue yields gradually. The controller keeps the shaft
# in the moving trocar.
TROCAR_SPEED = 0.03
_EXPERT_IMAGE_SIZE = 128  # pixels, side of the expert's picture; a policy brings its own size


class AgentSpec(NamedTuple):
    """An agent by name.

    Attributes:
      label: text for the page.
      task: name of its task.
      file: policy file, or None for the expert.
      arms: robots that the policy was trained with.
    """

    label: str
    task: str
    file: Path | None
    arms: tuple[str, ...]


def expert(task: str) -> AgentSpec:
    """Returns the task's scripted expert."""
    slots = registries.tasks.get(task).slots
    return AgentSpec(EXPERT, task, None, tuple(slot.arm for slot in slots))


def from_file(file: Path, name: str = "") -> AgentSpec:
    """Returns a trained policy.

    Raises:
      errors.UsageError: the file is damaged, or not a policy of this version.
    """
    trained = in_env.read(file)
    label = f"{methods.METHODS[trained.method].label} ({name or file.parent.name})"
    return AgentSpec(label, trained.scene.task, file, trained.scene.arms)


def available(task: str) -> list[AgentSpec]:
    """Lists the expert and the packaged policies of a task."""
    specs = [from_file(packaged.locate(name), name) for name in packaged.names()]
    return [expert(task), *(spec for spec in specs if spec.task == task)]


class LiveState(NamedTuple):
    """An unfinished episode.

    Attributes:
      env: EnvState `[1]`.
      memory: the agent's, `[1]`.
      t: control steps taken.
      p_planned: `[1, A, 3]` in m, the trocars at the last plan.
    """

    env: Any
    memory: Any
    t: jax.Array
    p_planned: Any = None


class Simulation(NamedTuple):
    """An agent in an environment.

    Attributes:
      label: the agent's, for the page.
      env: the environment.
      start: (seed, index of the trocar configuration, trial, another trocar with fields `[A]` or
        None) -> (LiveState, Frame).
      step: (LiveState, target p_world_trocar `[A, 3]` m) -> (LiveState, Frame on the host).
      look: LiveState -> camera's name -> `[h, w, 3]` uint8.
      monitor: the policy's runtime monitor, if it has one.
    """

    label: str
    env: sim_env.Env
    start: Callable[[int, int, int, Trocar | None], tuple[LiveState, Frame]]
    step: Callable[[LiveState, np.ndarray], tuple[LiveState, Frame]]
    look: Callable[[LiveState], dict[str, jax.Array]]
    monitor: Monitor | None = None


def load(spec: AgentSpec, arms: tuple[str, ...] = ()) -> Simulation:
    """Makes the closed loop of an agent, on its own robots unless `arms` names others."""
    if spec.file is None:
        env = sim_env.make(spec.task, arms, observation="state", image_size=_EXPERT_IMAGE_SIZE)
        return make(spec.label, env, agents.from_single(env.task.expert()))
    policy = in_env.place_in_own_scene(spec.file, in_env.read(spec.file), arms=arms)
    params = (policy.trained.params, policy.trained.normalizer)
    made = make(spec.label, policy.env, policy.agent(), params)
    return made._replace(monitor=policy.trained.monitor)


def make(label: str, env: sim_env.Env, agent: agents.BatchAgent, params: Any = None) -> Simulation:
    """Makes the functions of a Simulation, each compiled by its first call."""
    observe = jax.vmap(env.observe)
    execute = agent.about.get("execute", 0)

    @Program
    def start(params: Any, key: jax.Array, trocar: Trocar) -> tuple[LiveState, Frame]:
        key_env, key_agent = jax.random.split(key)
        state = env.reset(key_env, sim_env.EnvParams(trocar))
        state = jax.tree.map(lambda x: jnp.asarray(x)[None], state)
        memory = agent.init(params, key_agent[None], state, lambda: observe(state))
        live = LiveState(state, memory, jnp.zeros((), jnp.int32), state.trocar.p_world_trocar)
        return live, frame(env, live)

    @Program
    def step(params: Any, live: LiveState, target: jax.Array) -> tuple[LiveState, Frame]:
        def moved(state: sim_env.EnvState) -> sim_env.EnvState:
            p = state.trocar.p_world_trocar
            p_next = moving_trocars.toward(p, target, TROCAR_SPEED / env.control_hz)
            return moving_trocars.move_trocars(env, state, jnp.where(state.done, p, p_next))

        before = jax.vmap(moved)(live.env)
        command, memory, _ = agent.act(params, live.memory, before, lambda: observe(before), live.t)
        # A plan was made for the trocars of its first step: carry its commands to the present ones.
        p = before.trocar.p_world_trocar
        p_planned = jnp.where(live.t % max(execute, 1) == 0, p, live.p_planned)
        command = moving_trocars.carried(env.task, command, p_planned, p)
        live = LiveState(jax.vmap(env.step)(before, command), memory, live.t + 1, p_planned)
        return live, frame(env, live, execute)

    def begin(
        seed: int, configuration: int, trial: int, trocar: Trocar | None = None
    ) -> tuple[LiveState, Frame]:
        key = trial_key.of_trial(seed, configuration, trial)
        live, first = start(params, key, trocar or task_trocar(env, configuration))
        return live, jax.device_get(first)

    def advance(live: LiveState, target: np.ndarray) -> tuple[LiveState, Frame]:
        live, after = step(params, live, np.asarray(target, np.float32))
        return live, jax.device_get(after)

    look = camera(env)
    return Simulation(label, env, begin, advance, lambda live: look(live.env))


def camera(env: sim_env.Env) -> Callable[[Any], dict[str, jax.Array]]:
    """Makes a compiled EnvState `[1]` -> camera's name -> `[h, w, 3]` uint8."""

    @Program
    def look(state: EnvState) -> dict[str, jax.Array]:
        images = env.camera(jax.tree.map(lambda x: x[0], state))
        return {name: image.rgb for name, image in images.items()}

    return look


def task_trocar(env: sim_env.Env, configuration: int) -> Trocar:
    """Returns a configuration of the task's trocars, fields `[A]`."""
    return Trocar(*(np.asarray(field[configuration]) for field in env.task.trocars))


def frame(env: sim_env.Env, live: LiveState, execute: int = 0) -> Frame:
    """Makes the frame of an episode, with the plan of an agent that executes `execute` commands."""
    state = jax.tree.map(lambda x: x[0], live.env)
    plan = jnp.zeros((0, *state.pose.p.shape))
    if execute and isinstance(live.memory, agents.Plan):
        plan = live.memory.command.pose.p[0]
        # From the next command on; past the end, the last one repeats to keep the shape.
        ahead = (live.t - 1) % execute + 1 + jnp.arange(len(plan))
        plan = plan[jnp.minimum(ahead, len(plan) - 1)]
    return Frame(
        step=live.t,
        qpos=state.coordinates,
        p_world_trocar=state.trocar.p_world_trocar,
        p_world_tip=state.pose.p,
        rcm_error=state.rcm_error,
        rgb=env.task.colours(env.scene.bound, state.layout, jnp.asarray(env.scene.geom_rgb)),
        plan=plan,
        stage=state.stage,
        reward=state.reward,
        done=state.done,
        success=state.success & ~state.invalid,
        invalid=state.invalid,
        collided=state.collided,
        gripper=state.gripper,
        still=None if env.task.still is None else env.task.still(state.layout),
    )
