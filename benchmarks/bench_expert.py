"""Success of the scripted expert: the task's trocars, and others drawn from Eq. 19.

    python benchmarks/bench_expert.py [--per-trocar 100] [--sampled 500] [--seed 2026] \\
        [--task peg_transfer] [--arm fr5] [--expert default] [--seconds 0]

Demonstrations are worth as much as their expert: this is printed before any figure of a policy.
"""

import argparse
import time

import _scene
import _timing
import jax
import jax.numpy as jnp
import numpy as np

from starjax import errors, rcm, runtime
from starjax.evaluation import statistics
from starjax.sim import env as envs
from starjax.sim import sampling
from starjax.types import Agent

STEPS = 600  # control steps, 20 s, that demonstrations may take too
CHUNK = {"cpu": 16}  # episodes at once
CHUNK_GPU = 600


def main() -> None:
    runtime.prepare_xla()
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--per-trocar", type=int, default=100)
    parser.add_argument("--sampled", type=int, default=500)
    parser.add_argument("--seed", type=int, default=2026)
    parser.add_argument("--expert", default="", help="by default the task's first one")
    parser.add_argument("--seconds", type=float, default=0.0, help="of an episode; 0: enough")
    _scene.add_flags(parser)
    arguments = parser.parse_args()
    environment = _scene.make(arguments, observation="state")
    experts = environment.task.experts
    expert = arguments.expert or next(iter(experts))
    errors.choice("expert", expert, experts)
    agent, listed = environment.task.expert(expert), environment.task.trocars
    key = jax.random.key(arguments.seed)
    twelve = rcm.Trocar(*(jnp.repeat(jnp.asarray(f), arguments.per_trocar, axis=0) for f in listed))
    drawn = sampling.sample_trocars(
        jax.random.fold_in(key, 1), environment.task, (arguments.sampled,)
    )
    enough = max(STEPS, environment.task.least_steps)
    steps = round(arguments.seconds * environment.control_hz) or enough
    results = {
        "seed": arguments.seed,
        "scene": environment.names._asdict(),
        "expert": expert,
        "seconds": steps / environment.control_hz,
        "twelve": _score(
            environment, agent, twelve, jax.random.fold_in(key, 2), steps, "the task's"
        ),
        "eq19": _score(environment, agent, drawn, jax.random.fold_in(key, 3), steps, "from Eq. 19"),
    }
    name = _scene.result_name("expert", environment.names)
    print("written to", _timing.write(name, results))


def _score(
    environment: envs.Env,
    agent: Agent,
    trocars: rcm.Trocar,
    key: jax.Array,
    steps: int,
    name: str,
) -> dict:
    """Outcome of one expert episode at each configuration of trocars `[N, A]`."""
    count = len(trocars.radius)
    chunk = min(count, CHUNK.get(jax.default_backend(), CHUNK_GPU))
    keys = jax.random.split(key, count)
    run = jax.jit(jax.vmap(lambda key, trocar: _episode(environment, agent, key, trocar, steps)))
    start, parts = time.perf_counter(), []
    for first in range(0, count, chunk):
        # The last chunk is filled up with its first lanes, which are not counted.
        index = np.resize(np.arange(first, min(first + chunk, count)), chunk)
        part = run(keys[index], jax.tree.map(lambda leaf, i=index: leaf[i], trocars))
        parts.append(jax.tree.map(lambda leaf, f=first: np.asarray(leaf)[: count - f], part))
    outcome = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    success, taken, distances, live = (outcome[k] for k in ("success", "step", "errors", "live"))
    low, high = statistics.wilson(int(success.sum()), count)
    executed = distances[live] * 1e3  # of the arm that is farthest off
    summary = {
        "episodes": count,
        "successes": int(success.sum()),
        "rate": float(success.mean()),
        "ci95": [low, high],
        "collided": int(outcome["collided"].sum()),
        "collided_successes": int((outcome["collided"] & success).sum()),
        "invalid": int(outcome["invalid"].sum()),
        "median_transfer_s": float(np.median(taken[success])) / environment.control_hz,
        "rcm_error_mm": {
            "mean": float(executed.mean()),
            "p99": float(np.quantile(executed, 0.99)),
            "max": float(executed.max()),
        },
        "wall_s": time.perf_counter() - start,
    }
    print(f"{name}: {summary}", flush=True)
    return summary


def _episode(
    environment: envs.Env, agent: Agent, key: jax.Array, trocar: rcm.Trocar, steps: int
) -> dict[str, jax.Array]:
    key_reset, key_expert = jax.random.split(key)
    state = environment.reset(key_reset, envs.EnvParams(trocar))

    def step(carry):
        state, memory, largest = carry
        command, memory, _ = agent.act(memory, state)
        after = environment.step(state, command)
        return after, memory, largest.at[state.step].set(jnp.max(after.rcm_error))

    start = (state, agent.init(key_expert, state), jnp.zeros(steps))
    state, _, largest = jax.lax.while_loop(lambda c: ~c[0].done & (c[0].step < steps), step, start)
    names = ("success", "step", "collided", "invalid")
    live = jnp.arange(steps) < state.step
    return {"errors": largest, "live": live, **{name: getattr(state, name) for name in names}}


if __name__ == "__main__":
    main()
