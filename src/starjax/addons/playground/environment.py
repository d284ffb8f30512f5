"""Tasks with the interface of a MuJoCo Playground environment, by duck typing.

>>> env = environment.make("reach")
>>> state = jax.jit(env.reset)(jax.random.key(0))
>>> state = jax.jit(env.step)(state, jnp.zeros(env.action_size))

One environment, for `vmap`, `jit` and `scan`. As in Playground, wrappers start new episodes and
apply the time limit `episode_length`. Playground's own for training, `wrap_for_brax_training`,
repeats the first state of each lane: its trocar and layout stay those of its first `reset`.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from starjax.envs import mdp, settings
from starjax.sim import assets


@flax.struct.dataclass
class State:
    """One episode.

    Attributes:
      data: `sim.state.EnvState`.
      obs: see `observing`.
      reward, done: float32; done is 1 where the episode has ended before its time.
      metrics: name -> float32, see `mdp.measure`.
      info: entries of wrappers, which `step` keeps.
    """

    data: Any
    obs: Any
    reward: jax.Array
    done: jax.Array
    metrics: dict[str, jax.Array]
    info: dict[str, Any]


class Environment(NamedTuple):
    """An environment as Playground's learners call it.

    Attributes:
      reset: key -> State.
      step: (State, action `[action_size]`) -> State.
      action_size: D.
      observation_size: O, or camera's name -> shape.
      episode_length: control steps of the time limit.
      dt, sim_dt: s, of a control step and of a physics step; n_substeps: their ratio.
      mj_model, mjx_model: the composed scene.
      episodes: the functions beneath, see `mdp.Episodes`.
    """

    reset: Callable[[jax.Array], State]
    step: Callable[[State, jax.Array], State]
    action_size: int
    observation_size: Any
    episode_length: int
    dt: float
    sim_dt: float
    n_substeps: int
    mj_model: mujoco.MjModel
    mjx_model: Any
    episodes: mdp.Episodes

    @property
    def unwrapped(self) -> "Environment":
        """Itself."""
        return self

    @property
    def xml_path(self) -> str:
        """The task's MJCF; arms and tools are composed with it, see `mj_model`."""
        return str(assets.path(self.episodes.env.task.mjcf))

    def render(self, trajectory: Any) -> Any:
        """Renders the first camera: `[h, w, 3]` uint8 of a state, a list for a list of states.

        Its size is the argument `image_size` of `make`.
        """
        camera = _compiled(self.episodes.camera)
        if isinstance(trajectory, list):
            return [np.asarray(camera(state.data)) for state in trajectory]
        return np.asarray(camera(trajectory.data))

    def __repr__(self) -> str:
        """Returns a line with the task, instead of all its models' arrays."""
        task, sizes = self.episodes.env.names.task, self.observation_size
        return f"Environment({task!r}, actions {self.action_size}, observations {sizes})"


@functools.lru_cache(8)
def _compiled(camera: Callable[[Any], jax.Array]) -> Callable[[Any], jax.Array]:
    """Returns the camera of some episodes, compiled once."""
    return jax.jit(camera)


def make(task: str, **arguments: Any) -> Environment:
    """Builds the environment.

    Args:
      arguments: see `settings.EnvSettings`.

    Raises:
      errors.UsageError: an argument is unknown or out of range.
    """
    made = mdp.make(settings.make(task=task, **arguments))
    scene = made.env.scene

    def metrics(data: Any) -> dict[str, jax.Array]:
        return {name: x.astype(jnp.float32) for name, x in made.measure(data).items()}

    def reset(rng: jax.Array) -> State:
        data, zero = made.reset(rng), jnp.zeros(())
        return State(data, made.observe(data), zero, zero, metrics(data), {})

    def step(state: State, action: jax.Array) -> State:
        data = made.step(state.data, action)
        outcome = made.judge(state.data, data)
        return state.replace(
            data=data,
            obs=made.observe(data),
            reward=outcome.reward,
            done=outcome.terminated.astype(jnp.float32),
            metrics={**state.metrics, **metrics(data)},
        )

    shapes = jax.eval_shape(lambda key: reset(key).obs, jax.random.key(0))
    sizes = jax.tree.map(lambda s: s.shape if s.ndim > 1 else s.shape[0], shapes)
    period, sim_dt = 1.0 / made.env.control_hz, float(scene.mj_model.opt.timestep)
    return Environment(
        reset=reset,
        step=step,
        action_size=made.action_size,
        observation_size=sizes,
        episode_length=made.max_steps,
        dt=period,
        sim_dt=sim_dt,
        n_substeps=round(period / sim_dt),
        mj_model=scene.mj_model,
        mjx_model=scene.mjx_model,
        episodes=made,
    )
