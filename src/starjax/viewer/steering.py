"""An environment that a person steers: one compiled step, with what a demonstration records."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.data import schema
from starjax.rcm.trocar import Trocar
from starjax.rollouts import episodes, programs
from starjax.sim import env as sim_env
from starjax.types import Command
from starjax.viewer import simulation
from starjax.viewer.frame import Frame


class Moment(NamedTuple):
    """After a control step, on the host.

    Attributes:
      frame: for the page.
      fields: of `episodes.DEMONSTRATION`, `[1, ...]` each.
      status: of `programs.status`, `[1]` each.
    """

    frame: Frame
    fields: dict[str, Any]
    status: dict[str, Any]


class Steering(NamedTuple):
    """An environment in a person's hands.

    Attributes:
      env: it.
      start: (seed, configuration of the task's trocars, trial) -> (EnvState `[1]`, Frame, the
        actions `[A, 4]` of `rcm4` and openings `[A]` that are there). It never is a trial of an
        evaluation.
      step: (EnvState `[1]`, actions `[A, 4]`, openings `[A]`) -> (EnvState `[1]`, Moment).
      look: EnvState `[1]` -> camera's name -> `[h, w, 3]` uint8.
      compile: () -> None, all of these; else their first calls do.
    """

    env: sim_env.Env
    start: Callable[[int, int, int], tuple[Any, Frame, np.ndarray, np.ndarray]]
    step: Callable[[Any, np.ndarray, np.ndarray], tuple[Any, Moment]]
    look: Callable[[Any], dict[str, jax.Array]]
    compile: Callable[[], None]


def make(env: sim_env.Env) -> Steering:
    """Makes the functions of an environment."""
    space = rcm.ACTION_SPACES["rcm4"]

    @jax.jit
    def start(key: jax.Array, trocar: Trocar) -> Any:
        state = env.reset(jax.random.split(key)[0], sim_env.EnvParams(trocar))
        action = space.encode(state.pose, state.measured_trocar)
        opening = state.gripper
        state = jax.tree.map(lambda x: jnp.asarray(x)[None], state)
        return state, _frame(env, state), action, opening

    @jax.jit
    def step(before: Any, action: jax.Array, opening: jax.Array) -> tuple[Any, Moment]:
        pose, _ = space.decode(action[None], before.measured_trocar)
        command = Command(pose, opening[None])
        after = jax.vmap(env.step)(before, command)
        seen = jax.vmap(env.observe)(before)
        fields = episodes.DEMONSTRATION.fields(episodes.Step(seen, command, command, before, after))
        carry = programs.RolloutState(after, (), after.step, jnp.ones(1, bool))
        return after, Moment(_frame(env, after), fields, programs.status(env, carry))

    @jax.jit
    def look(state: Any) -> dict[str, jax.Array]:
        one = jax.tree.map(lambda x: x[0], state)
        return {name: frame.rgb for name, frame in env.camera(one).items()}

    def begin(seed: int, configuration: int, trial: int) -> tuple[Any, Frame, Any, Any]:
        key = simulation.trial_key(seed, configuration, trial, schema.STREAM)
        chosen = Trocar(*(np.asarray(field[configuration]) for field in env.task.trocars))
        state, *shown = start(key, chosen)
        return state, *jax.device_get(shown)

    def advance(state: Any, action: np.ndarray, opening: np.ndarray) -> tuple[Any, Moment]:
        state, moment = step(state, np.float32(action), np.float32(opening))
        return state, jax.device_get(moment)

    def compile_all() -> None:
        state, _, actions, openings = begin(0, 0, 0)
        look(advance(state, actions, openings)[0])

    return Steering(env, begin, advance, look, compile_all)


def _frame(env: sim_env.Env, state: Any) -> Frame:
    return simulation.frame(env, simulation.Carry(state, (), state.step[0]))
