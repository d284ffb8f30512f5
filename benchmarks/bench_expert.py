"""Success of the scripted expert: the twelve trocars, and ports drawn from Eq. 19.

    python benchmarks/bench_expert.py [--per-trocar 100] [--sampled 500] [--seed 2026]

Demonstrations are worth as much as their expert: this is printed before any figure of a policy.
"""

import argparse
import time

import _timing
import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm, runtime
from starjax.evaluation import statistics
from starjax.sim import env as envs
from starjax.sim.tasks.peg_transfer import expert

STEPS = 600  # control steps, 20 s; the limit of a policy's trial is 60 s
CHUNK = {"cpu": 16}  # episodes at once
CHUNK_GPU = 600


def main() -> None:
    runtime.prepare_xla()
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--per-trocar", type=int, default=100)
    parser.add_argument("--sampled", type=int, default=500)
    parser.add_argument("--seed", type=int, default=2026)
    arguments = parser.parse_args()
    environment = envs.make("state")
    key = jax.random.key(arguments.seed)
    twelve = rcm.Trocar(
        *(jnp.repeat(jnp.asarray(f), arguments.per_trocar, axis=0) for f in rcm.TROCARS)
    )
    drawn = rcm.sample_trocar(jax.random.fold_in(key, 1), (arguments.sampled,))
    results = {
        "seed": arguments.seed,
        "twelve": _score(environment, twelve, jax.random.fold_in(key, 2), "the twelve"),
        "eq19": _score(environment, drawn, jax.random.fold_in(key, 3), "from Eq. 19"),
    }
    print("written to", _timing.write("expert", results))


def _score(environment: envs.Env, trocars: rcm.Trocar, key: jax.Array, name: str) -> dict:
    """Outcome of one expert episode at each trocar `[N]`."""
    count = len(trocars.radius)
    chunk = min(count, CHUNK.get(jax.default_backend(), CHUNK_GPU))
    keys = jax.random.split(key, count)
    run = jax.jit(jax.vmap(lambda key, trocar: _episode(environment, key, trocar)))
    start, parts = time.perf_counter(), []
    for first in range(0, count, chunk):
        # The last chunk is filled up with its first lanes, which are not counted.
        index = np.resize(np.arange(first, min(first + chunk, count)), chunk)
        part = run(keys[index], jax.tree.map(lambda leaf, i=index: leaf[i], trocars))
        parts.append(jax.tree.map(lambda leaf, f=first: np.asarray(leaf)[: count - f], part))
    outcome = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    success, steps, errors, live = (outcome[k] for k in ("success", "step", "errors", "live"))
    low, high = statistics.wilson(int(success.sum()), count)
    executed = errors[live] * 1e3
    summary = {
        "episodes": count,
        "successes": int(success.sum()),
        "rate": float(success.mean()),
        "ci95": [low, high],
        "collided": int(outcome["collided"].sum()),
        "invalid": int(outcome["invalid"].sum()),
        "median_transfer_s": float(np.median(steps[success])) / environment.control_hz,
        "rcm_error_mm": {
            "mean": float(executed.mean()),
            "p99": float(np.quantile(executed, 0.99)),
            "max": float(executed.max()),
        },
        "wall_s": time.perf_counter() - start,
    }
    print(f"{name}: {summary}", flush=True)
    return summary


def _episode(environment: envs.Env, key: jax.Array, trocar: rcm.Trocar) -> dict[str, jax.Array]:
    key_reset, key_expert = jax.random.split(key)
    state = environment.reset(key_reset, envs.EnvParams(trocar))

    def step(carry):
        state, script, errors = carry
        command, script = expert.act(script, state)
        after = environment.step(state, command)
        return after, script, errors.at[state.step].set(after.rcm_error)

    start = (state, expert.init(key_expert, state), jnp.zeros(STEPS))
    state, _, errors = jax.lax.while_loop(lambda c: ~c[0].done & (c[0].step < STEPS), step, start)
    names = ("success", "step", "collided", "invalid")
    live = jnp.arange(STEPS) < state.step
    return {"errors": errors, "live": live, **{name: getattr(state, name) for name in names}}


if __name__ == "__main__":
    main()
