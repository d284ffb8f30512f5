"""Physics steps a second: MJX at several batch sizes beside C MuJoCo on one thread.

    python benchmarks/bench_sim.py [--batches 1 16 256]

Both step the same composed model from the same state: arm at home, block standing on its peg. On a
CPU batch 256 takes minutes, which is why it is not among the defaults.
"""

import argparse

import _timing
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from starjax import runtime
from starjax.sim import model, physics
from starjax.sim.tasks import peg_transfer
from starjax.types import Pose

PERIODS = 1  # control periods a call
PERIOD = 1 / 30  # s


def main() -> None:
    runtime.prepare_xla()
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 16])
    batches = parser.parse_args().batches
    sim = model.load()
    block = Pose(jnp.eye(3), jnp.array([*sim.pegs[4], peg_transfer.RIM_HEIGHT]))
    start = physics.initial(sim, jnp.asarray(sim.home), block)
    substeps = round(PERIOD / sim.mj_model.opt.timestep)

    def run(state: physics.PhysicsState) -> physics.PhysicsState:
        still = jnp.zeros(6)

        def period(_, state):
            home = jnp.asarray(sim.home)
            return physics.advance(sim, state, home, still, still, jnp.ones(()), PERIOD)[0]

        return jax.lax.fori_loop(0, PERIODS, period, state)

    data = mujoco.MjData(sim.mj_model)
    data.qpos[:] = np.asarray(start.qpos)
    data.ctrl[:] = [*sim.home, physics.JAW_OPEN]
    peer = _timing.time_plain(
        lambda: [mujoco.mj_step(sim.mj_model, data) for _ in range(PERIODS * substeps * 16)]
    )
    c_rate = PERIODS * substeps * 16 / peer.median_s
    print(f"C MuJoCo, one thread: {c_rate:,.0f} steps/s")
    rows = {}
    for batch in batches:
        states = jax.tree.map(lambda leaf, n=batch: jnp.stack([leaf] * n), start)
        timing = _timing.time_jitted(jax.vmap(run), states, repeats=3)
        rate = batch * PERIODS * substeps / timing.median_s
        rows[str(batch)] = {
            "steps_per_s": rate,
            "ratio_to_c": rate / c_rate,
            "compile_s": timing.compile_s,
        }
        print(f"MJX, batch {batch}: {rate:,.0f} steps/s, {rate / c_rate:.2f} of C", flush=True)
    print("written to", _timing.write("sim", {"c_steps_per_s": c_rate, "mjx": rows}))


if __name__ == "__main__":
    main()
