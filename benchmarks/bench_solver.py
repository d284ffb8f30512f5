"""Error and speed of one physics step in float32: our contact solver beside MJX's own.

    python benchmarks/bench_solver.py [--episodes 48]

Right is what MJX's solver ends at in float64, with iterations to spare. The states are those of
the scripted expert's episodes.
"""

import argparse

import _timing
import _visited
import jax
import jax.numpy as jnp
import numpy as np

from starjax import runtime
from starjax.sim import env as envs
from starjax.sim import solver
from starjax.sim.engine import mjx
from starjax.sim.scene import SimModel

# Of MJX's solver: iterations, line-search turns, tolerance.
EXACT = (100, 50, 1e-14)
SETTINGS = [(60, 40, 1e-9), (8, 8, 1e-7), (8, 6, 1e-7), (8, 4, 1e-7), (4, 8, 1e-7)]
QUANTILES = (0.5, 0.99, 0.999, 1.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=48)
    asked = parser.parse_args()
    runtime.prepare_xla()
    env = envs.make("state")
    sim = env.model
    inputs = _visited.states(env, asked.episodes)
    with jax.enable_x64(True):
        double = jax.tree.map(in_float64, (sim, inputs))
        exact = np.asarray(program(double[0], mjx.step, with_settings(double[0], EXACT))(double[1]))
    print("error of the block, mm/s: 50%, 99%, 99.9%, all; us a step")
    found = {"starjax": (solver.step, sim.mjx_model)}
    for settings in SETTINGS:
        name = "MJX, {} iterations, {} turns, tolerance {:g}".format(*settings)
        found[name] = mjx.step, with_settings(sim, settings)
    rows = {}
    block = slice(sim.block_dof, sim.block_dof + 3)
    for name, (step, model) in found.items():
        run = program(sim, step, model)
        error = np.abs(np.asarray(run(inputs)) - exact)[:, block].max(-1)
        seconds = _timing.time_plain(lambda run=run: jax.block_until_ready(run(inputs)), repeats=3)
        quantiles = 1e3 * np.quantile(error, QUANTILES)
        rows[name] = dict(zip(("p50", "p99", "p999", "max"), quantiles.tolist(), strict=True))
        rows[name]["us_a_step"] = 1e6 * seconds.median_s / len(error)
        print(name.ljust(46), " ".join(f"{value:10.4g}" for value in rows[name].values()))
    print("written to", _timing.write("solver", {"states": len(exact), "block_mm_s": rows}))


def in_float64(leaf):
    """The same number, in float64 if it is in float32."""
    is_float = getattr(leaf, "dtype", None) == jnp.float32
    return jnp.asarray(leaf, jnp.float64) if is_float else leaf


def with_settings(sim: SimModel, settings: tuple[int, int, float]) -> mjx.Model:
    """MJX's model with other limits of its solver."""
    iterations, turns, tolerance = settings
    option = sim.mjx_model.opt
    return sim.mjx_model.replace(
        opt=option.replace(
            iterations=iterations,
            ls_iterations=turns,
            tolerance=jnp.asarray(tolerance, option.tolerance.dtype),
        )
    )


def program(sim: SimModel, step, model: mjx.Model):
    """Compiled: velocities `[N, V]` after one step of N states."""
    one = _visited.stepper(sim, step, model)
    batch = _visited.CPU_LANES
    return jax.jit(lambda x: jax.lax.map(lambda y: one(*y).qvel, x, batch_size=batch))


if __name__ == "__main__":
    main()
