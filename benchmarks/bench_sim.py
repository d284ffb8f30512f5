"""Physics steps a second: MJX at several batch sizes beside C MuJoCo on one thread.

    python benchmarks/bench_sim.py [--batches 360 4096 16384]

Both step the same composed model from the same state: arm at home, block standing on its peg. A
CPU steps a batch 16 at a time, as `evaluation.rollout` does: jaxlib 0.10's batched Cholesky waits
for ever on two cores when a large batch is factored twice at once.
"""

import argparse

import _c_mujoco
import _peer
import _timing
import jax
import jax.numpy as jnp

from starjax import runtime
from starjax.evaluation import rollout
from starjax.sim import model, physics

PERIODS = 8  # control periods a call
PERIOD = 1 / 30  # s
BATCHES = {"cpu": [1, 16, 256], "gpu": [360, 4096, 16384]}


def main() -> None:
    runtime.prepare_xla()
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batches", type=int, nargs="+", default=BATCHES[_peer.platform()])
    batches = parser.parse_args().batches
    sim = model.load()
    start = _c_mujoco.at_rest(sim)
    substeps = round(PERIOD / sim.mj_model.opt.timestep)

    def run(state: physics.PhysicsState) -> physics.PhysicsState:
        still = jnp.zeros(6)

        def period(_, state):
            home = jnp.asarray(sim.home)
            return physics.advance(sim, state, home, still, still, jnp.ones(()), PERIOD)[0]

        return jax.lax.fori_loop(0, PERIODS, period, state)

    def step_all(states: physics.PhysicsState) -> physics.PhysicsState:
        if jax.default_backend() == "cpu":
            return jax.lax.map(run, states, batch_size=rollout.CPU_LANES)
        return jax.vmap(run)(states)

    c_rate = _c_mujoco.steps_per_s(sim)
    print(f"C MuJoCo, one thread: {c_rate:,.0f} steps/s")
    for batch in batches:
        states = jax.tree.map(lambda leaf, n=batch: jnp.repeat(leaf[None], n, axis=0), start)
        timing, _ = _timing.time_carried(step_all, states, repeats=5)
        rate = batch * PERIODS * substeps / timing.median_s
        row = {
            "steps_per_s": rate,
            "ms_a_step": 1e3 * timing.median_s / PERIODS / substeps,
            "c_steps_per_s": c_rate,
            "ratio_to_c": rate / c_rate,
            "compile_s": timing.compile_s,
            "temporary_bytes_an_environment": timing.temporary_bytes / batch,
        }
        print(f"MJX, batch {batch}: {rate:,.0f} steps/s, {rate / c_rate:.2f} of C", flush=True)
        _timing.report("sim", {"results": {str(batch): row}}, tiny=False)


if __name__ == "__main__":
    main()
