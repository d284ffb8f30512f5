"""Error of one physics step under coarser solver settings, against a solver that has converged.

    python benchmarks/bench_solver.py [--episodes 48]

The states are those of the scripted expert's episodes, 8 s each, so most of them hold contacts; the
servos hold the arm, and the jaws close.
"""

import argparse

import _timing
import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm, runtime
from starjax.evaluation import rollout
from starjax.sim import env as envs
from starjax.sim import physics
from starjax.sim.engine import mjx
from starjax.sim.model import SimModel
from starjax.sim.tasks import expert

STEPS = 240  # control steps an episode
CONVERGED = (60, 40, 1e-9)  # iterations, line-search turns, tolerance
SETTINGS = [(8, 8, 1e-8), (8, 8, 1e-7), (8, 8, 1e-5), (8, 7, 1e-7), (8, 6, 1e-7), (8, 4, 1e-7)]
QUANTILES = (0.99, 0.999, 1.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=48)
    asked = parser.parse_args()
    runtime.prepare_xla()
    env = envs.make("state")
    states = visited(env, asked.episodes)
    exact = step(env.model, *CONVERGED)(states)
    print("iterations turns tolerance   error of the block, mm/s: 99%, 99.9%, all")
    rows = {}
    for settings in SETTINGS:
        error = jnp.abs(step(env.model, *settings)(states) - exact)
        first = env.model.block_dof
        linear = 1e3 * np.quantile(np.max(error[:, first : first + 3], -1), QUANTILES)
        name = "{} iterations, {} turns, tolerance {:g}".format(*settings)
        rows[name] = dict(zip(("p99", "p999", "max"), linear.tolist(), strict=True))
        print(name.ljust(44), " ".join(f"{value:10.4g}" for value in linear), flush=True)
    print("written to", _timing.write("solver", {"states": len(exact), "block_mm_s": rows}))


def visited(env: envs.Env, episodes: int) -> tuple[physics.PhysicsState, jax.Array]:
    """States `[N]` of episodes of the expert, and the joint servos' targets `[N, 6]` there."""
    index = jnp.arange(episodes)
    trocars = jax.tree.map(lambda field: jnp.asarray(field)[index % 12], rcm.TROCARS)

    def episode(inputs):
        key, trocar = inputs
        state = env.reset(key, envs.EnvParams(trocar))

        def act(carry, _):
            state, script = carry
            command, script = expert.act(script, state)
            after = env.step(state, command)
            return (after, script), (state.sim, after.q_target)

        return jax.lax.scan(act, (state, expert.init(key, state)), None, length=STEPS)[1]

    keys = jax.random.split(jax.random.key(11), episodes)
    batch = rollout.CPU_LANES
    found = jax.jit(lambda x: jax.lax.map(episode, x, batch_size=batch))((keys, trocars))
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), found)


def step(sim: SimModel, iterations: int, turns: int, tolerance: float):
    """Compiled: velocities `[N, V]` after one physics step from `visited` states."""
    model = sim.mjx_model
    option = model.opt.replace(iterations=iterations, ls_iterations=turns, tolerance=tolerance)
    model = model.replace(opt=option)

    def one(inputs):
        state, target = inputs
        data = sim.mjx_data.replace(
            qpos=state.qpos,
            qvel=state.qvel,
            qacc_warmstart=state.qacc_warmstart,
            ctrl=jnp.append(target, physics.JAW_CLOSED),
        )
        return mjx.step(model, data).qvel

    return jax.jit(lambda x: jax.lax.map(one, x, batch_size=rollout.CPU_LANES))


if __name__ == "__main__":
    main()
