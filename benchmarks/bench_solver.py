"""Error and speed of one physics step in float32: our contact solver and MJX's own.

    python benchmarks/bench_solver.py [--episodes 48]

The reference is the result of MJX's solver in float64, with iterations to spare. The states are
those of the scripted expert's episodes.
"""

import argparse

import _timing
import _visited
import jax
import jax.numpy as jnp
import numpy as np

from starjax import runtime
from starjax.sim import env as envs
from starjax.sim.quiet_mjx import mjx
from starjax.sim.scene import Scene

# MJX's solver: iterations, line-search turns, tolerance.
EXACT = (100, 50, 1e-14)
SETTINGS = [(60, 40, 1e-9), (8, 8, 1e-7), (8, 6, 1e-7), (8, 4, 1e-7), (4, 8, 1e-7)]
QUANTILES = (0.5, 0.99, 0.999, 1.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=48)
    asked = parser.parse_args()
    runtime.prepare_xla()
    env = envs.make(observation="state")
    scene, inputs = env.scene, _visited.moments(env, asked.episodes)
    with jax.enable_x64(True):
        models = scene.mjx_model, scene.mjx_data, inputs
        model, data, wide = jax.tree.map(in_float64, models)
        double = with_settings(scene._replace(mjx_model=model, mjx_data=data), EXACT)
        exact = np.asarray(program(double, mjx.step)(wide))
    print("error of the block, mm/s: 50%, 99%, 99.9%, all; us a step")
    found = {"starjax": (_visited.starjax_step, scene)}
    for settings in SETTINGS:
        name = "MJX, {} iterations, {} turns, tolerance {:g}".format(*settings)
        found[name] = mjx.step, with_settings(scene, settings)
    rows = {}
    block = slice(scene.bound.block_dof, scene.bound.block_dof + 3)
    for name, (step, changed) in found.items():
        run = program(changed, step)
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


def with_settings(scene: Scene, settings: tuple[int, int, float]) -> Scene:
    """The scene with other limits of MJX's solver."""
    iterations, turns, tolerance = settings
    option = scene.mjx_model.opt
    model = scene.mjx_model.replace(
        opt=option.replace(
            iterations=iterations,
            ls_iterations=turns,
            tolerance=jnp.asarray(tolerance, option.tolerance.dtype),
        )
    )
    return scene._replace(mjx_model=model)


def program(scene: Scene, step: _visited.Step):
    """Compiled: velocities `[N, V]` after one step of N moments."""
    one = _visited.stepper(scene, step)
    batch = _visited.CPU_LANES
    return jax.jit(lambda x: jax.lax.map(lambda y: one(y).state.qvel, x, batch_size=batch))


if __name__ == "__main__":
    main()
