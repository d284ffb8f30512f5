"""A driven needle in our physics and in C MuJoCo: the same commands of the expert, side by side.

    python experiments/needle_drive/drive.py [--per-trocar 3] [--task needle_drive] [--arm psm]

The expert drives a needle through the pad in our physics. Its commands are then repeated in C
MuJoCo: entry, exit and force across the hole of both, and how far apart the two needles are. The
forces of pad and jaws are the same program in both; the physics step around it is not. No time.
"""

import argparse
import pathlib
import sys
from typing import Any

sys.path.append(str(pathlib.Path(__file__).parents[2] / "benchmarks"))
import _c_env
import _scene
import _timing
import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from starjax import rcm, runtime
from starjax.core.types import Command
from starjax.sim import env as envs

STEPS = 300  # control steps, 10 s: all drives are over
SEED = 2026
TASK, ARM = "needle_drive", "psm"


def main() -> None:
    runtime.prepare_xla()
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--per-trocar", type=int, default=3)
    _scene.add_flags(parser)
    parser.set_defaults(task=TASK, arm=[ARM])
    arguments = parser.parse_args()
    env = _scene.make(arguments, observation="state")
    trocars = jax.tree.map(
        lambda field: jnp.repeat(jnp.asarray(field), arguments.per_trocar, axis=0),
        env.task.trocars,
    )
    keys = jax.random.split(jax.random.key(SEED), len(trocars.radius))
    ours, commands = jax.jit(jax.vmap(lambda key, trocar: _expert(env, key, trocar)))(keys, trocars)
    other = _c_env.with_c_physics(env)
    theirs = jax.jit(jax.vmap(lambda *episode: _repeat(other, *episode)))(keys, trocars, commands)
    rows = {"ours": _figures(ours), "c_mujoco": _figures(theirs), "between": _between(ours, theirs)}
    for name, row in rows.items():
        print(name, row)
    results = {
        "seed": SEED,
        "scene": env.names._asdict(),
        "episodes": len(keys),
        "results": rows,
    }
    print("written to", _timing.write(_scene.result_name("drive", env.names), results))


def _expert(env: envs.Env, key: jax.Array, trocar: rcm.Trocar) -> tuple[envs.EnvState, Command]:
    """Returns the states and the commands `[T]` of an expert's episode."""
    agent, (key_env, key_agent) = env.task.expert(), jax.random.split(key)
    state = env.reset(key_env, envs.EnvParams(trocar))

    def step(carry: Any, _: None) -> Any:
        state, memory = carry
        _, memory, command = agent.act(memory, state)  # without the noise of demonstrations
        state = env.step(state, command)
        return (state, memory), (state, command)

    _, found = jax.lax.scan(step, (state, agent.init(key_agent, state)), length=STEPS)
    return found


def _repeat(env: envs.Env, key: jax.Array, trocar: rcm.Trocar, commands: Command) -> envs.EnvState:
    """Returns the states `[T]` of an episode that repeats commands."""
    state = env.reset(jax.random.split(key)[0], envs.EnvParams(trocar))

    def step(state: envs.EnvState, command: Command) -> Any:
        state = env.step(state, command)
        return state, state

    return jax.lax.scan(step, state, commands)[1]


def _figures(states: envs.EnvState) -> dict[str, Any]:
    """Returns successes, and the largest figures over the episodes."""
    last = jax.tree.map(lambda leaf: np.asarray(leaf)[:, -1], states.measurements)
    return {
        "successes": int(np.asarray(states.success)[:, -1].sum()),
        "entry_off_mm": 1e3 * float(last.entry_off.max()),
        "exit_off_mm": 1e3 * float(last.exit_off.max()),
        "force_N": float(last.max_force.max()),
        "rcm_error_mm": 1e3 * float(np.max(states.rcm_error)),
    }


def _between(ours: envs.EnvState, theirs: envs.EnvState) -> dict[str, float]:
    """Returns the largest differences between the two, while neither episode is over."""
    one, other = (jax.tree.map(np.asarray, s.measurements) for s in (ours, theirs))
    runs = ~np.asarray(ours.done | theirs.done)
    needle = np.linalg.norm(one.needle.p - other.needle.p, axis=-1)[runs]
    relative = np.swapaxes(one.needle.R, -1, -2) @ other.needle.R
    turn = Rotation.from_matrix(relative[runs]).magnitude()
    off = np.abs(one.exit_off[:, -1] - other.exit_off[:, -1])
    force = np.abs(one.max_force[:, -1] - other.max_force[:, -1])
    return {
        "needle_mm": 1e3 * float(needle.max()),
        "needle_deg": float(np.rad2deg(turn.max())),
        "exit_mm": 1e3 * float(off.max()),
        "force_N": float(force.max()),
    }


if __name__ == "__main__":
    main()
