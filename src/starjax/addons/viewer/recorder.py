"""Demonstrations by an operator: a steered environment, and a recorder of its episodes.

With a policy, the operator relieves it: episodes that the operator took part in are interventions.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.addons.viewer import simulation, tip_handle
from starjax.addons.viewer.frame import Frame
from starjax.core.types import Command
from starjax.data import schema, store
from starjax.policies.monitor.record import Monitor
from starjax.rcm.trocar import Trocar
from starjax.runtime import files
from starjax.runtime.precompile import Program
from starjax.sim import env as sim_env
from starjax.sim import wrists
from starjax.sim.rollouts import episodes, programs, takeover, trial_key
from starjax.sim.rollouts import trocars as configurations
from starjax.sim.state import Env

OPERATOR = "operator"  # in dataset.json, in place of a scripted expert's name


class Moment(NamedTuple):
    """Result of a control step, on the host.

    Attributes:
      frame: for the page.
      fields: those of `episodes.DEMONSTRATION`, and with a policy `actor`, `[1, ...]` each.
      status: that of `programs.status`, `[1]` each.
      action: `[A, D]`, see `Steering`, the command.
      opening: `[A]`, the commanded openings.
    """

    frame: Frame
    fields: dict[str, Any]
    status: dict[str, Any]
    action: Any
    opening: Any


class Relieved(NamedTuple):
    """A policy that an operator relieves.

    Attributes:
      agent: `rollouts.agent.BatchAgent` of the policy.
      params: its parameters.
      digest: of its file.
      obs_horizon: O, moments that it observes.
      execute: commands of a plan that it executes.
      monitor: its runtime monitor, if it has one.
    """

    agent: Any
    params: Any
    digest: str
    obs_horizon: int
    execute: int
    monitor: Monitor | None = None


class Steering(NamedTuple):
    """An environment that an operator steers.

    Attributes:
      env: the environment.
      start: (seed, index of the trocar configuration, trial) -> (LiveState, Frame, present actions
        `[A, D]`, present openings `[A]`). Never a trial of an evaluation. Actions have roll and
        tip, D = 4, and with a wrist pitch and yaw, D = 6.
      step: (LiveState, actions `[A, D]`, openings `[A]`, True if the operator acts) -> (LiveState,
        Moment).
      look: LiveState -> camera's name -> `[h, w, 3]` uint8.
      compile: () -> None, compiles the other three; without it, their first calls do.
      policy: that the operator relieves, or None.
    """

    env: sim_env.Env
    start: Callable[[int, int, int], tuple[Any, Frame, np.ndarray, np.ndarray]]
    step: Callable[[Any, np.ndarray, np.ndarray, bool], tuple[Any, Moment]]
    look: Callable[[Any], dict[str, jax.Array]]
    compile: Callable[[], None]
    policy: Relieved | None = None


def steer(env: sim_env.Env, policy: Relieved | None = None) -> Steering:
    """Makes the functions of a Steering."""
    wrist = wrists.common(env.task)
    space = rcm.action_space("rcm4" if wrist is None else "rcm6", wrist)
    to_action = slice(None) if wrist is None else tip_handle.FROM_RCM6
    from_action = slice(None) if wrist is None else tip_handle.TO_RCM6
    camera, observe = simulation.camera(env), jax.vmap(env.observe)
    params, execute = (None, 0) if policy is None else (policy.params, policy.execute)

    @Program
    def start(params: Any, key: jax.Array, trocar: Trocar) -> Any:
        key_env, key_agent = jax.random.split(key)
        state = env.reset(key_env, sim_env.EnvParams(trocar))
        action = space.encode(state.pose, state.measured_trocar)[..., to_action]
        opening = state.gripper
        state, memory = jax.tree.map(lambda x: jnp.asarray(x)[None], state), ()
        if policy is not None:
            memory = policy.agent.init(params, key_agent[None], state, lambda: observe(state))
        live = simulation.LiveState(state, memory, jnp.zeros((), jnp.int32))
        return live, simulation.frame(env, live), action, opening

    @Program
    def step(
        params: Any, live: simulation.LiveState, action: jax.Array, opening: jax.Array, acts: Any
    ) -> tuple[simulation.LiveState, Moment]:
        before, memory, actor = live.env, live.memory, {}
        p_world_trocar = before.measured_trocar.p_world_trocar
        pose, _ = space.decode(action[None, :, from_action], before.measured_trocar)
        command = wrists.through(env.task, Command(pose, opening[None]), p_world_trocar)
        if policy is not None:
            # Also while the operator acts: its observations and its plan stay up to date.
            look = lambda: observe(before)  # noqa: E731
            planned, memory, _ = policy.agent.act(params, memory, before, look, live.t)
            if planned.wrist is None:  # a straight one
                planned = wrists.through(env.task, planned, p_world_trocar)
            command = jax.tree.map(lambda x, y: jnp.where(acts, x, y), command, planned)
            who = jnp.where(acts, takeover.PERSON, takeover.POLICY).astype(jnp.uint8)
            actor = {takeover.ACTOR: who[None]}
        after = jax.vmap(env.step)(before, command)
        fields = episodes.DEMONSTRATION.fields(
            episodes.Step(observe(before), command, command, before, after)
        )
        carry = programs.RolloutState(after, (), after.step, jnp.ones(1, bool))
        live = simulation.LiveState(after, memory, live.t + 1)
        now = space.encode(command.pose, before.measured_trocar)[0, :, to_action]
        now = now, command.gripper[0]
        status = programs.status(env, carry)
        return live, Moment(simulation.frame(env, live, execute), {**fields, **actor}, status, *now)

    def begin(seed: int, configuration: int, trial: int) -> tuple[Any, Frame, Any, Any]:
        key = trial_key.of_trial(seed, configuration, trial, schema.STREAM)
        state, *host = start(params, key, simulation.task_trocar(env, configuration))
        return state, *jax.device_get(host)

    def advance(
        state: Any, action: np.ndarray, opening: np.ndarray, acts: bool = True
    ) -> tuple[Any, Moment]:
        state, moment = step(params, state, np.float32(action), np.float32(opening), acts)
        return state, jax.device_get(moment)

    def look(state: Any) -> dict[str, jax.Array]:
        return camera(state.env)

    def compile_all() -> None:
        state, _, actions, openings = begin(0, 0, 0)
        look(advance(state, actions, openings)[0])

    return Steering(env, begin, advance, look, compile_all, policy)


class Recorder:
    """A recorder of one episode after another into the folder `root`."""

    def __init__(self, root: Path, env: Env, seed: int, policy: Relieved | None = None):
        self._root, self._seed, self._policy = root, seed, policy
        self._trocars = configurations.listed(env.task.trocars, len(env.p_world_ref))
        steps = round(env.task.time_limit_s * env.control_hz)
        settings = schema.DemoSettings(per_trocar=0, seed=seed, max_steps=steps, keep_failures=True)
        description = schema.describe(env, self._trocars, settings)
        if policy is not None:
            description = takeover.with_actor(description, takeover.INTERVENTION, policy.digest)
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

    @property
    def is_worth_saving(self) -> bool:
        """True once something was recorded, with a policy something by the operator."""
        if self._policy is None:
            return bool(self._moments)
        return any(moment.fields[takeover.ACTOR][0] for moment in self._moments)

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
        moments, about = self._moments, {}
        if self._policy is not None:
            acted = (i for i, x in enumerate(moments) if x.fields[takeover.ACTOR][0])
            first = max(next(acted) - (self._policy.obs_horizon - 1), 0)
            digest = self._policy.digest
            moments = moments[first:]
            about = {"source": takeover.INTERVENTION, "policy": digest, "first": first}
        fields = {
            name: np.stack([moment.fields[name][0] for moment in moments])
            for name in moments[0].fields
        }
        images = {n: [x] for n, x in fields.items() if n.startswith(episodes.IMAGE)}
        others = {n: x[None] for n, x in fields.items() if n not in images}
        status = {**moments[-1].status, "length": np.array([len(moments)])}
        episode = episodes.assemble(
            0, (configuration, trial), self._trocars, self._seed, status, [others], images
        )
        key = store.key(configuration, trial, self._seed)
        outcome = {**episode.outcome, **about}
        self._records[key] = store.commit(self._root, key, outcome, episode.arrays)
        store.seal(self._root, self._records)
        self.discard()
        return self._root / "episodes" / key


@contextlib.contextmanager
def record_into(
    root: Path, env: Env, seed: int, policy: Relieved | None = None
) -> Iterator[Recorder]:
    """Yields a recorder into a folder, which stays locked until the end.

    Raises:
      files.StorageError: another process holds the folder, or it has another dataset.
    """
    with files.lock(root):
        yield Recorder(root, env, seed, policy)
