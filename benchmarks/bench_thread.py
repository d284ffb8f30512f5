"""Physics steps per second of a straight tool, a wrist, and a wrist with a thread, in one run.

    python benchmarks/bench_thread.py [--batches 360]

Whole control periods of the environment with the arm at rest: control, physics, measurements. The
scenes take turns: other work on the machine slows all of them; a share is the median of
the turns' own. Programs are compiled side by side.
"""

import argparse
import statistics
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import _peer
import _timing
import jax
import jax.numpy as jnp

from starjax import runtime
from starjax.addons.suture import thread
from starjax.core.types import Command
from starjax.sim import env as envs

PERIODS, ROUNDS = 20, 9  # control periods per call; calls of each scene
BATCHES = {"cpu": [16], "gpu": [360]}  # environments
SCENES = {
    "straight": ("needle_pick", "grasper"),
    "wrist": ("needle_pick", "needle_driver"),
    "wrist_and_thread": ("suture_throw", "needle_driver"),
}


def main() -> None:
    runtime.prepare_xla()
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    usual = BATCHES[_peer.platform()]
    parser.add_argument("--batches", type=int, nargs="+", default=usual, help="environments")
    batches = parser.parse_args().batches
    made = {
        name: envs.make(task, ["psm"], [tool], observation="state")
        for name, (task, tool) in SCENES.items()
    }
    with ThreadPoolExecutor() as pool:
        waiting = {
            batch: {name: pool.submit(_held, env, batch) for name, env in made.items()}
            | {"thread": pool.submit(_thread, batch)}
            for batch in batches
        }
        ready = {
            batch: {name: job.result() for name, job in jobs.items()}
            for batch, jobs in waiting.items()
        }
    substeps = {
        name: round(1.0 / env.control_hz / env.scene.mj_model.opt.timestep)
        for name, env in made.items()
    }
    rows = {str(batch): _row(runs, batch, substeps) for batch, runs in ready.items()}
    for batch, row in rows.items():
        figures = ", ".join(f"{name} {value:,.4g}" for name, value in row.items())
        print(f"{batch} environments: {figures}", flush=True)
    _timing.report("thread", {"results": rows}, tiny=False)


def _row(runs: dict[str, Any], batch: int, substeps: dict[str, int]) -> dict[str, float]:
    """Returns the figures of one number of environments, whose programs take turns."""
    times: dict[str, list[float]] = {name: [] for name in runs}
    for turn in range(1 + ROUNDS):
        for name, (run, start) in runs.items():
            begin = time.perf_counter()
            jax.block_until_ready(run(start))
            if turn > 0:  # the first one is not counted
                times[name].append(time.perf_counter() - begin)
    steps = {name: batch * PERIODS * count for name, count in substeps.items()}
    row = {f"steps_per_s_{name}": steps[name] / statistics.median(times[name]) for name in SCENES}
    row |= {f"share_{name}": _ratio(times["straight"], times[name]) for name in SCENES}
    row["thread_over_a_wristed_step"] = _ratio(times["thread"], times["wrist"])
    return row


def _ratio(one: list[float], other: list[float]) -> float:
    """Returns the median ratio of the times of one turn."""
    return statistics.median(a / b for a, b in zip(one, other, strict=True))


def _held(env: envs.Env, batch: int):
    """Returns the compiled program of some control periods at rest, and its start."""
    trocar = jax.tree.map(lambda field: jnp.asarray(field)[0], env.task.trocars)
    keys = jax.random.split(jax.random.key(0), batch)
    start = jax.jit(jax.vmap(lambda key: env.reset(key, envs.EnvParams(trocar))))(keys)

    def hold(state):
        return env.step(state, Command(state.pose, jnp.ones(1), state.wrist))

    @jax.jit
    def run(state):
        return jax.lax.fori_loop(0, PERIODS, lambda _, state: jax.vmap(hold)(state), state)

    return run.lower(start).compile(), start


def _thread(batch: int):
    """Returns the same of a thread alone, whose tail goes round."""
    first = thread.laid(jnp.array([0.0, 0.0, 0.02]), jnp.zeros(()), jnp.asarray(40.0), 0.0)
    start = jax.tree.map(lambda leaf: jnp.repeat(jnp.asarray(leaf)[None], batch, 0), first)

    @jax.jit
    def run(now):
        def one(i, now):
            tail = 0.02 * jnp.stack([jnp.sin(0.05 * i), 1.0 - jnp.cos(0.05 * i), 1.0])
            return jax.vmap(
                lambda led: thread.advance(led, tail, thread.NO_HOLE, 0.0, 1.0 / envs.CONTROL_HZ)
            )(now)

        return jax.lax.fori_loop(0, PERIODS, one, now)

    return run.lower(start).compile(), start


if __name__ == "__main__":
    main()
