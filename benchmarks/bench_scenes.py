"""Physics steps per second of every scene, against C MuJoCo on a thread; two arms against one.

    python benchmarks/bench_scenes.py [--batches 360 4096] [--only reach needle_pick] [--peer]

Every task with its own arms, at rest: arms at home, objects where an episode begins. `--peer` also
times `mjx.step`, with MJX's own contact solver. `bench_sim.py --task T` has one scene at work.
Programs are compiled side by side.
"""

import argparse
import functools
import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import _c_mujoco
import _peer
import _timing
import _visited
import bench_sim
import jax
import jax.numpy as jnp

from starjax import runtime
from starjax.sim import registries, solver
from starjax.sim import scene as scenes
from starjax.sim.quiet_mjx import mjx

BATCHES = {"cpu": [1, 16], "gpu": [360, 4096]}
# A task of two arms, and the same of one.
SAME_WORK = {"peg_transfer_bimanual": "peg_transfer", "needle_handover": "needle_pick"}


def main() -> None:
    runtime.prepare_xla()
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batches", type=int, nargs="+", default=BATCHES[_peer.platform()])
    parser.add_argument("--only", nargs="+", default=registries.tasks.names(), help="tasks")
    parser.add_argument("--peer", action="store_true", help="time mjx.step too")
    asked = parser.parse_args()
    found = {task: scenes.load(scenes.name(task)) for task in asked.only}
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        waiting = {
            task: {
                (kind, batch): pool.submit(compiled, scene, kind, batch)
                for kind in ("", "mjx_")[: 1 + asked.peer]
                for batch in asked.batches
            }
            for task, scene in found.items()
        }
        ready = {
            task: {k: job.result() for k, job in jobs.items()} for task, jobs in waiting.items()
        }
    rows: dict[str, dict[str, Any]] = {}
    for task, scene in found.items():
        c_rate = _c_mujoco.steps_per_s(scene)
        rows[task] = {"arms": list(scene.names.arms), "c_steps_per_s": c_rate}
        for (kind, batch), run in ready[task].items():
            start = repeated(scene, batch)
            timing = _timing.time_plain(
                lambda run=run, start=start: jax.block_until_ready(run(start)), repeats=3
            )
            rows[task][f"{kind}steps_per_s_{batch}"] = batch * bench_sim.STEPS / timing.median_s
        if one := rows.get(SAME_WORK.get(task, "")):
            for batch in asked.batches:
                name = f"steps_per_s_{batch}"
                rows[task][f"share_of_one_arm_{batch}"] = rows[task][name] / one[name]
        figures = {k: v for k, v in rows[task].items() if isinstance(v, float)}
        print(f"{task}: " + ", ".join(f"{k} {v:,.4g}" for k, v in figures.items()), flush=True)
    _timing.report("scenes", {"results": rows}, tiny=False)


def compiled(scene: scenes.Scene, kind: str, batch: int) -> Any:
    """`bench_sim.program` of this many environments, ahead of time."""
    ours = functools.partial(_ours, max_iterations=scene.max_solver_iterations)
    program = bench_sim.program(scene, mjx.step if kind else ours)
    return program.lower(repeated(scene, batch)).compile()


def repeated(scene: scenes.Scene, batch: int) -> _visited.Moment:
    """So many environments at rest."""
    rest = _visited.at_rest(scene)
    return jax.tree.map(lambda leaf: jnp.repeat(jnp.asarray(leaf)[None], batch, axis=0), rest)


def _ours(model: mjx.Model, data: mjx.Data, max_iterations: int | None) -> mjx.Data:
    return solver.step(model, data, max_iterations, data.qfrc_applied)[0]


if __name__ == "__main__":
    main()
