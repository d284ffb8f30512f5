"""Demonstrations by an operator: a steered environment, and a recorder of its episodes."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.data import schema, store
from starjax.rcm.trocar import Trocar
from starjax.rollouts import episodes, programs
from starjax.rollouts import trocars as configurations
from starjax.runtime import files
from starjax.sim import env as sim_env
from starjax.types import Command
from starjax.viewer import simulation
from starjax.viewer.frame import Frame

OPERATOR = "operator"  # in dataset.json, in place of a scripted expert's name


class Moment(NamedTuple):
    """Result of a control step, on the host.

    Attributes:
      frame: for the page.
      fields: those of `episodes.DEMONSTRATION`, `[1, ...]` each.
      status: that of `programs.status`, `[1]` each.
    """

    frame: Frame
    fields: dict[str, Any]
    status: dict[str, Any]


class Steering(NamedTuple):
    """An environment that an operator steers.

    Attributes:
      env: the environment.
      start: (seed, index of the trocar configuration, trial) -> (EnvState `[1]`, Frame, present
        actions `[A, 4]` of `rcm4`, present openings `[A]`). Never a trial of an evaluation.
      step: (EnvState `[1]`, actions `[A, 4]`, openings `[A]`) -> (EnvState `[1]`, Moment).
      look: EnvState `[1]` -> camera's name -> `[h, w, 3]` uint8.
      compile: () -> None, compiles the other three; without it, their first calls do.
    """

    env: sim_env.Env
    start: Callable[[int, int, int], tuple[Any, Frame, np.ndarray, np.ndarray]]
    step: Callable[[Any, np.ndarray, np.ndarray], tuple[Any, Moment]]
    look: Callable[[Any], dict[str, jax.Array]]
    compile: Callable[[], None]


def steer(env: sim_env.Env) -> Steering:
    """Makes the functions of a Steering."""
    space = rcm.ACTION_SPACES["rcm4"]
    look = simulation.camera(env)

    def frame(state: Any) -> Frame:
        return simulation.frame(env, simulation.LiveState(state, (), state.step[0]))

    @jax.jit
    def start(key: jax.Array, trocar: Trocar) -> Any:
        state = env.reset(jax.random.split(key)[0], sim_env.EnvParams(trocar))
        action, opening = space.encode(state.pose, state.measured_trocar), state.gripper
        state = jax.tree.map(lambda x: jnp.asarray(x)[None], state)
        return state, frame(state), action, opening

    @jax.jit
    def step(before: Any, action: jax.Array, opening: jax.Array) -> tuple[Any, Moment]:
        pose, _ = space.decode(action[None], before.measured_trocar)
        command = Command(pose, opening[None])
        after = jax.vmap(env.step)(before, command)
        observation = jax.vmap(env.observe)(before)
        fields = episodes.DEMONSTRATION.fields(
            episodes.Step(observation, command, command, before, after)
        )
        carry = programs.RolloutState(after, (), after.step, jnp.ones(1, bool))
        return after, Moment(frame(after), fields, programs.status(env, carry))

    def begin(seed: int, configuration: int, trial: int) -> tuple[Any, Frame, Any, Any]:
        key = simulation.trial_key(seed, configuration, trial, schema.STREAM)
        state, *host = start(key, simulation.task_trocar(env, configuration))
        return state, *jax.device_get(host)

    def advance(state: Any, action: np.ndarray, opening: np.ndarray) -> tuple[Any, Moment]:
        state, moment = step(state, np.float32(action), np.float32(opening))
        return state, jax.device_get(moment)

    def compile_all() -> None:
        state, _, actions, openings = begin(0, 0, 0)
        look(advance(state, actions, openings)[0])

    return Steering(env, begin, advance, look, compile_all)


class Recorder:
    """A recorder of one episode after another into the folder `root`."""

    def __init__(self, root: Path, env: Any, seed: int):
        self._root, self._seed = root, seed
        self._trocars = configurations.listed(env.task.trocars, len(env.p_world_ref))
        steps = round(env.task.time_limit_s * env.control_hz)
        settings = schema.DemoSettings(per_trocar=0, seed=seed, max_steps=steps, keep_failures=True)
        description = schema.describe(env, self._trocars, settings)
        store.create(root, {**description, "expert": OPERATOR})
        store.clean(root)
        self._records = {key: store.verify(root, key, arrays=False) for key in store.keys(root)}
        self._moments: list[Moment] = []

    @property
    def kept(self) -> int:
        """Number of successful episodes in the dataset."""
        return sum(record["success"] for record in self._records.values())

    @property
    def saved(self) -> int:
        """Number of episodes in the dataset, failed ones included."""
        return len(self._records)

    @property
    def moments(self) -> Sequence[Moment]:
        """The control steps of the unsaved episode."""
        return self._moments

    @property
    def length(self) -> int:
        """Control steps of the episode so far."""
        return len(self._moments)

    def next_trial(self, configuration: int) -> int:
        """Returns the number of the next trial through a trocar configuration."""
        trials = [r["trial"] for r in self._records.values() if r["trocar"] == configuration]
        return max(trials, default=-1) + 1

    def add(self, moment: Moment) -> None:
        """Records a control step."""
        self._moments.append(moment)

    def discard(self) -> None:
        """Discards the unsaved episode."""
        self._moments.clear()

    def save(self, configuration: int, trial: int) -> Path:
        """Writes the episode completely to disk; returns its folder.

        Raises:
          files.StorageError: the disk is full or cannot be written; the episode stays in memory.
        """
        fields = {
            name: np.stack([moment.fields[name][0] for moment in self._moments])
            for name in self._moments[0].fields
        }
        images = {n: [x] for n, x in fields.items() if n.startswith(episodes.IMAGE)}
        others = {n: x[None] for n, x in fields.items() if n not in images}
        status = {**self._moments[-1].status, "length": np.array([self.length])}
        episode = episodes.assemble(
            0, (configuration, trial), self._trocars, self._seed, status, [others], images
        )
        key = store.key(configuration, trial, self._seed)
        self._records[key] = store.commit(self._root, key, episode.outcome, episode.arrays)
        store.seal(self._root, self._records)
        self.discard()
        return self._root / "episodes" / key


@contextlib.contextmanager
def record_into(root: Path, env: Any, seed: int) -> Iterator[Recorder]:
    """Yields a recorder into a folder, which stays locked until the end.

    Raises:
      files.StorageError: another process holds the folder, or it has another dataset.
    """
    with files.lock(root):
        yield Recorder(root, env, seed)
