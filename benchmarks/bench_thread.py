"""Physics steps per second of a straight tool, a wrist, and a wrist with a thread, in one run.

    python benchmarks/bench_thread.py [--batch 16]

Whole control periods of the environment with the arm at rest: control, physics, measurements. The
scenes take turns, so that other work on the machine slows all of them.
"""

import argparse
import statistics
import time

import _timing
import jax
import jax.numpy as jnp

from starjax import runtime
from starjax.sim import env as envs
from starjax.sim import thread
from starjax.types import Command

PERIODS, ROUNDS = 20, 9  # control periods per call; calls of each scene
SCENES = {
    "straight": ("needle_pick", "grasper"),
    "wrist": ("needle_pick", "needle_driver"),
    "wrist_and_thread": ("suture_throw", "needle_driver"),
}


def main() -> None:
    runtime.prepare_xla()
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--batch", type=int, default=16, help="environments")
    batch = parser.parse_args().batch
    runs, substeps = {}, 0
    for name, (task, tool) in SCENES.items():
        env = envs.make(task, ["psm"], [tool], observation="state")
        substeps = round(1.0 / env.control_hz / env.scene.mj_model.opt.timestep)
        runs[name] = _held(env, batch)
        print(f"{name}: {task}, {tool}", flush=True)
    runs["thread"] = _thread(batch)
    for run, start in runs.values():
        jax.block_until_ready(run(start))
    times = {name: [] for name in runs}
    for _ in range(ROUNDS):
        for name, (run, start) in runs.items():
            begin = time.perf_counter()
            jax.block_until_ready(run(start))
            times[name].append(time.perf_counter() - begin)
    median = {name: statistics.median(values) for name, values in times.items()}
    count = batch * PERIODS * substeps
    row = {f"steps_per_s_{name}": count / median[name] for name in SCENES}
    row |= {f"share_{name}": median["straight"] / median[name] for name in SCENES}
    row["thread_over_a_wristed_step"] = median["thread"] / median["wrist"]
    print(", ".join(f"{name} {value:,.4g}" for name, value in row.items()))
    _timing.report("thread", {"results": {str(batch): row}}, tiny=False)


def _held(env: envs.Env, batch: int):
    """Returns the program of some control periods at rest, and its start."""
    trocar = jax.tree.map(lambda field: jnp.asarray(field)[0], env.task.trocars)
    keys = jax.random.split(jax.random.key(0), batch)
    start = jax.jit(jax.vmap(lambda key: env.reset(key, envs.EnvParams(trocar))))(keys)

    def hold(state):
        return env.step(state, Command(state.pose, jnp.ones(1), state.wrist))

    @jax.jit
    def run(state):
        return jax.lax.fori_loop(0, PERIODS, lambda _, state: jax.vmap(hold)(state), state)

    return run, start


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

    return run, start


if __name__ == "__main__":
    main()
