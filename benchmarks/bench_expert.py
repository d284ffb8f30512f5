"""Success of the scripted expert: the task's trocars, and others drawn from Eq. 19.

    python benchmarks/bench_expert.py [--per-trocar 100] [--sampled 500] [--seed 2026] \\
        [--task peg_transfer] [--arm fr5] [--tool grasper] [--expert default] [--seconds 0] [--c] \\
        [--disturbance cable_slack=1]

Committed figures of the built-in experts; `starjax check TASK` checks any expert.
"""

import argparse

import _c_env
import _scene
import _timing
import jax
import jax.numpy as jnp

from starjax import errors, rcm, runtime
from starjax.evaluation import expert as runs
from starjax.evaluation.disturbances import base
from starjax.sim import env as envs
from starjax.sim import sampling
from starjax.types import Agent

STEPS = 600  # control steps, 20 s, that demonstrations may take too


def main() -> None:
    runtime.prepare_xla()
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--per-trocar", type=int, default=100)
    parser.add_argument("--sampled", type=int, default=500)
    parser.add_argument("--seed", type=int, default=2026)
    parser.add_argument("--expert", default="", help="by default the task's first one")
    parser.add_argument("--seconds", type=float, default=0.0, help="of an episode; 0: enough")
    parser.add_argument("--c", action="store_true", help="C MuJoCo's physics instead of ours")
    parser.add_argument("--disturbance", default="", metavar="NAME=LEVEL")
    _scene.add_flags(parser)
    arguments = parser.parse_args()
    environment = _scene.make(arguments, observation="state")
    if arguments.c:
        environment = _c_env.with_c_physics(environment)
    if arguments.disturbance:
        environment = _disturbed(environment, *arguments.disturbance.split("="))
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
        "disturbance": arguments.disturbance,
        "twelve": _score(
            environment, agent, twelve, jax.random.fold_in(key, 2), steps, "the task's"
        ),
        "eq19": _score(environment, agent, drawn, jax.random.fold_in(key, 3), steps, "from Eq. 19"),
    }
    name = _scene.result_name("expert_c" if arguments.c else "expert", environment.names)
    name = "_".join([name, *filter(None, [arguments.disturbance.replace("=", "_")])])
    print("written to", _timing.write(name, results))


def _disturbed(environment: envs.Env, name: str, level: str) -> envs.Env:
    """The environment with a disturbance at one level in every episode."""
    whole = base.with_disturbances(environment, [name])
    levels = {name: float(level)}
    return whole._replace(
        reset=lambda key, params: whole.reset(key, params._replace(levels=levels))
    )


def _score(
    environment: envs.Env,
    agent: Agent,
    trocars: rcm.Trocar,
    key: jax.Array,
    steps: int,
    name: str,
) -> dict:
    """Outcome of one expert episode at each configuration of trocars `[N, A]`."""
    summary = runs.summary(
        runs.run(environment, agent, trocars, key, steps), environment.control_hz
    )
    print(f"{name}: {summary}", flush=True)
    return summary


if __name__ == "__main__":
    main()
