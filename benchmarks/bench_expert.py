"""Success, collisions and rests of scripted experts: the task's trocars, others drawn from Eq. 19.

    python benchmarks/bench_expert.py [--per-trocar 100] [--sampled 500] [--seed 2026] \\
        [--task peg_transfer] [--arm fr5] [--tool grasper] [--expert default] [--seconds 0] [--c] \\
        [--disturbance cable_slack=1]
    python benchmarks/bench_expert.py --all OUT.json [--workers 4] [--only TEXT ...]

`--all` runs every expert of the registry and those of `OTHERS`, several at once, and tests
them: no success collided, no episode invalid, and no rest before the judge's last settle.
Committed figures of the built-in experts; `starjax check TASK` checks any expert.
"""

import argparse
import copy
import json
import pathlib
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import _c_env
import _scene
import _timing
import jax
import jax.numpy as jnp

from starjax import rcm, runtime
from starjax.core import errors
from starjax.data import stillness
from starjax.evaluation import expert as runs
from starjax.evaluation.disturbances import base
from starjax.sim import env as envs
from starjax.sim import registries, sampling

STEPS = 600  # control steps, 20 s, that demonstrations may take too
# Rows of --all, apart from each expert with its task's own arms and tools: task, arm, tool, expert.
OTHERS = [
    *[("peg_transfer", arm, "", "default") for arm in ("ur5e", "panda", "iiwa14", "rcm4")],
    *[("peg_transfer", arm, "needle_driver", "default") for arm in ("fr5", "psm", "psm_si")],
    *[("needle_pick", arm, "needle_driver", "default") for arm in ("fr5", "psm")],
    ("needle_pick", "psm", "prograsp", "default"),
    ("needle_regrasp", "fr5", "", "default"),
    ("needle_drive", "fr5", "", "default"),
    ("peg_transfer_bimanual", "panda", "", "default"),
    ("needle_handover", "panda", "", "default"),
]
WRISTS = {("needle_handover", "wrist"): "needle_driver"}  # tools of experts that need another


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
    parser.add_argument("--all", metavar="OUT.json", help="all experts; results in one file, too")
    parser.add_argument("--only", nargs="*", default=[], help="with --all: rows with such a text")
    parser.add_argument("--workers", type=int, default=4, help="with --all: scenes at once")
    _scene.add_flags(parser)
    asked = parser.parse_args()
    if not asked.all:
        print("written to", _write(*_measured(asked)))
        return
    with ThreadPoolExecutor(asked.workers) as pool:
        results = dict(pool.map(lambda row: _row(asked, row), rows(asked.only)))
    pathlib.Path(asked.all).write_text(json.dumps(results, indent=1) + "\n")
    sys.exit(any(row["faults"] for row in results.values()))


def rows(only: list[str]) -> list[tuple[str, str, str, str]]:
    """Task, arm, tool and expert of every row, or of those with such a text in them."""
    own = [
        (name, "", WRISTS.get((name, expert), ""), expert)
        for name in registries.tasks.names()
        for expert in registries.tasks.get(name).experts
    ]
    listed = own + OTHERS
    return [row for row in listed if not only or any(text in _label(row) for text in only)]


def _label(row: tuple[str, str, str, str]) -> str:
    return " ".join(filter(None, row))


def _row(asked: argparse.Namespace, row: tuple[str, str, str, str]) -> tuple[str, dict[str, Any]]:
    one = copy.copy(asked)
    one.task, arm, tool, one.expert = row
    one.arm, one.tool = [arm] if arm else [], [tool] if tool else []
    name, start = _label(row), time.perf_counter()
    results: dict[str, Any]
    try:
        stem, results = _measured(one)
        if one.expert == next(iter(registries.tasks.get(one.task).experts)) or tool:
            _write(stem, results)
        parts = results["twelve"], results["eq19"]
        faults = {
            "collided successes": sum(part["collided_successes"] for part in parts),
            "invalid": sum(part["invalid"] for part in parts),
            "rests": sum(part["resting"] > stillness.RARELY * part["successes"] for part in parts),
        }
        results["faults"] = [fault for fault, count in faults.items() if count]
    except Exception as error:  # the other rows continue
        results = {"faults": [f"{type(error).__name__}: {error}"]}
    found = [f"{part}: {_text(results[part])}" for part in ("twelve", "eq19") if part in results]
    seconds = f"{time.perf_counter() - start:.0f} s"
    print(name, "|", *found, "|", *(results["faults"] or ["ok"]), "|", seconds, flush=True)
    return name, results


def _text(part: dict[str, Any]) -> str:
    rests = f"rests {part['longest_rest']} ({part['resting']})"
    return (
        f"{part['successes']}/{part['episodes']}, {part['collided']} collided, {part['invalid']} "
        f"invalid, {part['median_transfer_s']:.2f} s, {rests};"
    )


def _measured(asked: argparse.Namespace) -> tuple[str, dict[str, Any]]:
    """The result's name, and the outcome of one expert: all its episodes are of one program."""
    environment = _scene.make(asked, observation="state")
    if asked.c:
        environment = _c_env.with_c_physics(environment)
    if asked.disturbance:
        environment = _disturbed(environment, *asked.disturbance.split("="))
    experts = environment.task.experts
    expert = asked.expert or next(iter(experts))
    errors.choice("expert", expert, experts)
    agent, listed = environment.task.expert(expert), environment.task.trocars
    key = jax.random.key(asked.seed)
    own = rcm.Trocar(*(jnp.repeat(jnp.asarray(f), asked.per_trocar, axis=0) for f in listed))
    drawn = sampling.sample_trocars(jax.random.fold_in(key, 1), environment.task, (asked.sampled,))
    trocars = jax.tree.map(lambda *fields: jnp.concatenate(fields), own, drawn)
    enough = max(STEPS, environment.task.least_steps)
    steps = round(asked.seconds * environment.control_hz) or enough
    episodes = runs.run(environment, agent, trocars, jax.random.fold_in(key, 2), steps)
    count = len(own.radius)
    results = {
        "seed": asked.seed,
        "scene": environment.names._asdict(),
        "expert": expert,
        "seconds": steps / environment.control_hz,
        "disturbance": asked.disturbance,
        "twelve": runs.summary(runs.part(episodes, slice(count)), environment),
        "eq19": runs.summary(runs.part(episodes, slice(count, None)), environment),
    }
    name = _scene.result_name("expert_c" if asked.c else "expert", environment.names)
    return "_".join([name, *filter(None, [asked.disturbance.replace("=", "_")])]), results


def _write(name: str, results: dict[str, Any]) -> pathlib.Path:
    for part in ("twelve", "eq19"):
        print(f"{part}: {results[part]}", flush=True)
    return _timing.write(name, results)


def _disturbed(environment: envs.Env, name: str, level: str) -> envs.Env:
    """The environment with a disturbance at one level in every episode."""
    whole = base.with_disturbances(environment, [name])
    levels = {name: float(level)}
    return whole._replace(
        reset=lambda key, params: whole.reset(key, params._replace(levels=levels))
    )


if __name__ == "__main__":
    main()
