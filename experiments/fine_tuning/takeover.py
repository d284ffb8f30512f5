"""Rescuers in the middle of demonstrations, which they should continue.

    python experiments/fine_tuning/takeover.py [--episodes 12] [--task peg_transfer] \\
        [--arm A] [--tool T]

An expert's episodes run in C MuJoCo's physics. At every `EVERY`-th control step the rescuer enters
and sees the episode's next states; its labels should be those of the demonstration. Rows are the
stages of the task in the episodes. No time.
"""

import argparse
import pathlib
import sys
from collections.abc import Sequence
from typing import Any, NamedTuple

sys.path.append(str(pathlib.Path(__file__).parents[2] / "benchmarks"))
import _c_env
import _scene
import _timing
import jax
import jax.numpy as jnp
import numpy as np

from starjax import runtime
from starjax.sim import env as envs
from starjax.sim import registries
from starjax.sim.rescuer import Rescuer
from starjax.sim.task import CONTROL_HZ

SEED, STEPS = 31, 600  # a seed that no expert was adjusted on
EVERY = 7  # control steps between two entries
HORIZON = 8  # control steps that are compared: the executed part of a plan
TOLERANCE = 0.02  # m/s, of a tip's mean commanded velocity over the horizon; ways reach 0.09


class Episodes(NamedTuple):
    """Demonstrations of T steps in N episodes.

    Attributes:
      state: EnvState `[T, N]`, at each command.
      p: `[T, N, A, 3]` m, commanded tips, undisturbed.
      jaws: `[T, N, A]`.
    """

    state: Any
    p: jax.Array
    jaws: jax.Array


class Gaps(NamedTuple):
    """Rescuers against demonstrations, at M entries.

    Attributes:
      velocity: `[M]` m/s, difference of the mean velocities, the largest of all tips.
      jaws: `[M]`, difference of the openings at the end.
      stage: `[M]`, of the task.
      at: `[M, 2]`, step and episode.
    """

    velocity: np.ndarray
    jaws: np.ndarray
    stage: np.ndarray
    at: np.ndarray


def main() -> None:
    runtime.prepare_xla()
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--episodes", type=int, default=12)
    _scene.add_flags(parser)
    asked = parser.parse_args()
    environment = _c_env.with_c_physics(_scene.make(asked, observation="state"))
    task = environment.task
    expert = next(iter(task.experts))
    name = registries.rescuer_name(task, expert)
    found = recorded(environment, task.expert(expert), asked.episodes)
    gaps = compared(registries.rescuers.get(name), found)
    rows = summary(gaps, task.stages)
    for stage, row in rows.items():
        print(f"{stage}: {row}")
    results = {"tolerance_m_s": TOLERANCE, "results": {name: rows}}
    print("written to", _timing.write("takeover", results))


def recorded(environment: envs.Env, agent: Any, episodes: int) -> Episodes:
    """Returns demonstrations at the task's seen trocars in turn."""
    rows = np.resize(np.flatnonzero(environment.task.is_seen), episodes)
    trocars = jax.tree.map(lambda field: jnp.asarray(field[rows]), environment.task.trocars)
    keys = jax.random.split(jax.random.key(SEED), episodes)
    state = jax.jit(jax.vmap(environment.reset))(keys, envs.EnvParams(trocars))
    memory = jax.jit(jax.vmap(agent.init))(keys, state)

    @jax.jit
    @jax.vmap
    def drive(state: Any, memory: Any) -> Any:
        command, memory, label = agent.act(memory, state)
        return environment.step(state, command), memory, label

    steps = []
    for _ in range(max(STEPS, environment.task.least_steps)):
        before = state
        state, memory, label = drive(state, memory)
        steps.append((before, label.pose.p, label.gripper))
        if bool(state.done.all()):
            break
    return Episodes(*jax.tree.map(lambda *x: jnp.stack(x), *steps))


def compared(rescuer: Rescuer, found: Episodes) -> Gaps:
    """Returns the gaps at all entries whose horizon ends within the episode."""
    entries = [
        (t, n)
        for n in range(found.p.shape[1])
        for t in range(0, _length(found, n) - HORIZON, EVERY)
    ]
    at = np.array(entries)

    @jax.jit
    @jax.vmap
    def one(key: jax.Array, t: jax.Array, n: jax.Array) -> Any:
        def seen(x: jax.Array) -> jax.Array:
            return jax.lax.dynamic_slice_in_dim(x[:, n], t, HORIZON)

        state, p, jaws = jax.tree.map(seen, found)
        script = rescuer.resume(key, jax.tree.map(lambda x: x[0], state))

        def step(script: Any, state: Any) -> Any:
            _, script, label = rescuer.act(script, state)
            return script, (label.pose.p, label.gripper)

        _, (ours, ours_jaws) = jax.lax.scan(step, script, state)
        off = jnp.linalg.norm(ours[-1] - p[-1], axis=-1).max()
        return off * CONTROL_HZ / HORIZON, jnp.abs(ours_jaws[-1] - jaws[-1]).max(), state.stage[0]

    keys = jax.random.split(jax.random.key(SEED + 1), len(at))
    return Gaps(*map(np.asarray, one(keys, at[:, 0], at[:, 1])), at)


def summary(gaps: Gaps, stages: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Returns, by stage and for all, the entries and the share of those beyond the tolerance."""
    parts = {stage: gaps.stage == i for i, stage in enumerate(stages)} | {"all": gaps.stage >= 0}
    return {
        stage: {
            "entries": int(part.sum()),
            "beyond": int((gaps.velocity[part] > TOLERANCE).sum()),
            "median_m_s": float(np.median(gaps.velocity[part])),
            "p95_m_s": float(np.percentile(gaps.velocity[part], 95)),
            "jaws": int((gaps.jaws[part] > 1.0).sum()),
        }
        for stage, part in parts.items()
        if part.any()
    }


def _length(found: Episodes, episode: int) -> int:
    return int(np.sum(~np.asarray(found.state.done[:, episode])))


if __name__ == "__main__":
    main()
