"""Physics steps per second at several batch sizes, against C MuJoCo (one thread) and MJX's step.

    python benchmarks/bench_sim.py [--batches 360 4096 16384] [--peer] \\
        [--task peg_transfer] [--arm fr5]

At rest (arms at home, objects where an episode begins) and at work: states of the scripted expert's
episodes, with the jaws closing. `--peer` also times `mjx.step`, whose contact solver is MJX's, from
the same states. A CPU steps a batch 16 at a time, with threads: other work shows in the
cores that it got.
"""

import argparse

import _c_mujoco
import _peer
import _scene
import _timing
import _visited
import jax
import jax.numpy as jnp
import numpy as np

from starjax import runtime
from starjax.sim.quiet_mjx import mjx
from starjax.sim.scene import Scene

STEPS = 64  # physics steps a call
EPISODES = 48  # episodes of the expert, from which states are drawn
BATCHES = {"cpu": [1, 16, 256], "gpu": [360, 4096, 16384]}


def main() -> None:
    runtime.prepare_xla()
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batches", type=int, nargs="+", default=BATCHES[_peer.platform()])
    parser.add_argument("--peer", action="store_true", help="time mjx.step too")
    _scene.add_flags(parser)
    asked = parser.parse_args()
    env = _scene.make(asked, observation="state")
    rest, visited = _visited.at_rest(env.scene), _visited.moments(env, EPISODES)
    c_rate = _c_mujoco.steps_per_s(env.scene)
    print(f"C MuJoCo, one thread, at rest: {c_rate:,.0f} steps/s")
    steps = {"": _visited.starjax_step, **({"mjx_": mjx.step} if asked.peer else {})}
    for batch in asked.batches:
        drawn = np.random.default_rng(0).integers(0, len(visited.ctrl), batch)
        starts = {
            "at_rest": jax.tree.map(lambda leaf, n=batch: jnp.repeat(leaf[None], n, axis=0), rest),
            "at_work": jax.tree.map(lambda leaf, rows=drawn: jnp.asarray(leaf[rows]), visited),
        }
        # Scratch memory is of the environments that are stepped at once.
        lanes = min(batch, _visited.CPU_LANES) if jax.default_backend() == "cpu" else batch
        row = {"c_steps_per_s_at_rest": c_rate}
        for name, step in steps.items():
            run = program(env.scene, step).lower(starts["at_rest"]).compile()
            for kind, start in starts.items():
                timing = _timing.time_plain(
                    lambda run=run, start=start: jax.block_until_ready(run(start)), repeats=5
                )
                row[f"{name}steps_per_s_{kind}"] = batch * STEPS / timing.median_s
                row[f"{name}ms_a_step_{kind}"] = 1e3 * timing.median_s / STEPS
                row[f"{name}cores_{kind}"] = timing.cores
            memory = run.memory_analysis()
            row[f"{name}temporary_bytes_an_environment"] = memory.temp_size_in_bytes / lanes
        for kind in starts if asked.peer else ():
            row[f"times_mjx_speed_{kind}"] = (
                row[f"steps_per_s_{kind}"] / row[f"mjx_steps_per_s_{kind}"]
            )
        row["ratio_to_c_at_rest"] = row["steps_per_s_at_rest"] / c_rate
        print(f"batch {batch}: " + ", ".join(f"{key} {value:,.4g}" for key, value in row.items()))
        name = _scene.result_name("sim", env.names)
        _timing.report(name, {"results": {str(batch): row}}, tiny=False)


def program(scene: Scene, step: _visited.Step):
    """Jitted: `Moment [N] -> Moment [N]`, `STEPS` steps later."""
    one = _visited.stepper(scene, step)

    def run(now: _visited.Moment) -> _visited.Moment:
        return jax.lax.fori_loop(0, STEPS, lambda _, now: one(now), now)

    def run_all(batch: _visited.Moment) -> _visited.Moment:
        if jax.default_backend() == "cpu":
            return jax.lax.map(run, batch, batch_size=_visited.CPU_LANES)
        return jax.vmap(run)(batch)

    return jax.jit(run_all)


if __name__ == "__main__":
    main()
