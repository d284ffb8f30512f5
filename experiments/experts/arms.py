"""Success of scripted experts per arm, with wristed tools, in C MuJoCo.

    python experiments/experts/arms.py [--only ur5e/needle_driver/needle_drive ...] \\
        [--per-trocar 2] [--sampled 16] [--seed 2026]

The tool takes the place of a task's own. Rows of other runs stay. No peer, no time.
"""

import argparse
import itertools
import pathlib
import sys
from typing import Any

sys.path.append(str(pathlib.Path(__file__).parents[2] / "benchmarks"))
import _c_env
import _timing
import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm, runtime
from starjax.core.types import Agent
from starjax.evaluation import expert as runs
from starjax.sim import env as envs
from starjax.sim import registries, sampling

TOOLS = ("needle_driver", "prograsp")
# Tasks, and their experts for these tools.
TASKS = {
    "needle_drive": "default",
    "needle_regrasp": "default",
    "needle_pick": "default",
    "peg_transfer": "default",
    "needle_handover": "wrist",
}
STEPS = 600  # control steps, 20 s


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="*", default=[], help="rows, as psm/prograsp/needle_pick")
    parser.add_argument("--per-trocar", type=int, default=2)
    parser.add_argument("--sampled", type=int, default=16)
    parser.add_argument("--seed", type=int, default=2026)
    asked = parser.parse_args()
    runtime.prepare_xla()
    for parts in itertools.product(registries.arms.names(), TOOLS, TASKS):
        if not asked.only or "/".join(parts) in asked.only:
            row = score(*parts, asked.per_trocar, asked.sampled, asked.seed)
            print(*parts, row, flush=True)
            _timing.report("arms", {"results": {" ".join(parts): row}}, tiny=False)


def score(
    arm: str, tool: str, task: str, per_trocar: int, sampled: int, seed: int
) -> dict[str, Any]:
    """Outcome of one episode at each trocar, the task's repeated and others drawn: one program."""
    env = _c_env.with_c_physics(envs.make(task, [arm], [tool], observation="state"))
    key, agent = jax.random.key(seed), env.task.expert(TASKS[task])
    listed = rcm.Trocar(*(np.repeat(field, per_trocar, axis=0) for field in env.task.trocars))
    drawn = sampling.sample_trocars(jax.random.fold_in(key, 1), env.task, (sampled,))
    trocars = jax.tree.map(lambda *fields: jnp.concatenate(fields), listed, drawn)
    episodes = _run(env, agent, trocars, jax.random.fold_in(key, 2))
    own = len(listed.radius)
    return {
        "seed": seed,
        "expert": TASKS[task],
        "twelve": runs.summary(runs.part(episodes, slice(own)), env),
        "eq19": runs.summary(runs.part(episodes, slice(own, None)), env),
    }


def _run(env: envs.Env, agent: Agent, trocars: rcm.Trocar, key: jax.Array) -> runs.ExpertEpisodes:
    return runs.run(env, agent, trocars, key, max(STEPS, env.task.least_steps))


if __name__ == "__main__":
    main()
