"""Physics steps a second at several batch sizes, beside C MuJoCo on one thread and MJX's own step.

    python benchmarks/bench_sim.py [--batches 360 4096 16384] [--peer]

At rest (arm at home, block on its peg) and at work: states of the scripted expert's episodes, with
the jaws closing. `--peer` also times `mjx.step`, whose contact solver is MJX's, from the same
states. A CPU steps a batch 16 at a time.
"""

import argparse

import _c_mujoco
import _peer
import _timing
import _visited
import jax
import jax.numpy as jnp
import numpy as np

from starjax import runtime
from starjax.sim import env as envs
from starjax.sim import physics, solver
from starjax.sim.engine import mjx

STEPS = 64  # physics steps a call
EPISODES = 48  # of the expert, from which states are drawn
BATCHES = {"cpu": [1, 16, 256], "gpu": [360, 4096, 16384]}


def main() -> None:
    runtime.prepare_xla()
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batches", type=int, nargs="+", default=BATCHES[_peer.platform()])
    parser.add_argument("--peer", action="store_true", help="time mjx.step too")
    asked = parser.parse_args()
    env = envs.make("state")
    sim = env.model
    rest = _c_mujoco.at_rest(sim), jnp.asarray([*sim.home, physics.JAW_OPEN], jnp.float32)
    visited = _visited.states(env, EPISODES)
    c_rate = _c_mujoco.steps_per_s(sim)
    print(f"C MuJoCo, one thread, at rest: {c_rate:,.0f} steps/s")
    steps = {"": solver.step, "mjx_": mjx.step} if asked.peer else {"": solver.step}
    for batch in asked.batches:
        drawn = np.random.default_rng(0).integers(0, len(visited[1]), batch)
        starts = {
            "at_rest": jax.tree.map(lambda leaf, n=batch: jnp.repeat(leaf[None], n, axis=0), rest),
            "at_work": jax.tree.map(lambda leaf, rows=drawn: jnp.asarray(leaf[rows]), visited),
        }
        # Scratch memory is of the environments that are stepped at once.
        lanes = min(batch, _visited.CPU_LANES) if jax.default_backend() == "cpu" else batch
        row = {"c_steps_per_s_at_rest": c_rate}
        for name, step in steps.items():
            run = program(sim, step).lower(*starts["at_rest"]).compile()
            for kind, start in starts.items():
                timing = _timing.time_plain(
                    lambda run=run, start=start: jax.block_until_ready(run(*start)), repeats=5
                )
                row[f"{name}steps_per_s_{kind}"] = batch * STEPS / timing.median_s
                row[f"{name}ms_a_step_{kind}"] = 1e3 * timing.median_s / STEPS
            memory = run.memory_analysis()
            row[f"{name}temporary_bytes_an_environment"] = memory.temp_size_in_bytes / lanes
        for kind in starts if asked.peer else ():
            row[f"times_mjx_speed_{kind}"] = (
                row[f"steps_per_s_{kind}"] / row[f"mjx_steps_per_s_{kind}"]
            )
        row["ratio_to_c_at_rest"] = row["steps_per_s_at_rest"] / c_rate
        print(f"batch {batch}: " + ", ".join(f"{key} {value:,.4g}" for key, value in row.items()))
        _timing.report("sim", {"results": {str(batch): row}}, tiny=False)


def program(sim, step):
    """Jitted: `(PhysicsState [N], ctrl [N, 7]) -> PhysicsState [N]`, `STEPS` steps later."""
    one = _visited.stepper(sim, step, sim.mjx_model)

    def run(state, ctrl):
        return jax.lax.fori_loop(0, STEPS, lambda _, state: one(state, ctrl), state)

    def run_all(*batch):
        if jax.default_backend() == "cpu":
            return jax.lax.map(lambda x: run(*x), batch, batch_size=_visited.CPU_LANES)
        return jax.vmap(run)(*batch)

    return jax.jit(run_all)


if __name__ == "__main__":
    main()
