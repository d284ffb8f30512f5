"""Collecting demonstrations: 240 of them, 256 x 256 pixels, 30 Hz; and its waits.

    python benchmarks/bench_collect.py [--image 256] [--per-trocar 30] [--folder DIR] [--tiny]

`demos.collect` at the eight seen trocars, as `starjax collect` calls it, with programs that have
run one segment before the clock starts: compilation is timed apart. Simulating, copying pictures to
the host and writing overlap; its time is divided by the waits, of each core on a CPU.
Compared with one thread of C MuJoCo doing the physics steps alone, and a plain sequential write
of the same bytes with fsync in the same folder.
"""

import argparse
import os
import pathlib
import tempfile
import time
from unittest import mock

import _c_mujoco
import _peer
import _timing
import _visited
import numpy as np

from starjax import rcm, runtime
from starjax.data import demos, schema, store
from starjax.sim import env as envs
from starjax.sim.rollouts import agent, engine, episodes, fetching, placement, trocars, workers

SEEN = 8
MAX_STEPS = 600
PLAIN_BYTES = 1 << 30


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    small = _peer.platform() == "cpu"
    parser.add_argument("--image", type=int, default=64 if small else 256)
    parser.add_argument("--per-trocar", type=int, default=2 if small else 30)
    parser.add_argument(
        "--chunk", type=int, default=workers.CPU_LANES if small else demos.GPU_LANES
    )
    parser.add_argument("--folder", help="where a temporary folder is made; default: the system's")
    parser.add_argument("--tiny", action="store_true", help="a test's sizes, nothing is written")
    asked = parser.parse_args()
    runtime.prepare_xla()
    if asked.tiny:
        asked.image, asked.per_trocar, asked.chunk = 16, 1, SEEN
    env = envs.make(image_size=asked.image)
    expert, chosen = agent.from_single(_visited.expert(env)), seen(env)
    rules = engine.RolloutSettings(0, schema.STREAM, MAX_STEPS, asked.chunk)
    simulate = engine.make(env, expert, chosen, rules, episodes.DEMONSTRATION)
    group = [(lane % SEEN, lane // SEEN) for lane in range(asked.chunk)]
    first_s, again_s = (_timing.time_once(lambda: next(simulate(None, group))) for _ in range(2))
    with tempfile.TemporaryDirectory(dir=asked.folder) as folder:
        root = pathlib.Path(folder) / "demos"
        spent = collect(root, simulate, env, expert, asked)
        plain_rate = plain_write(pathlib.Path(folder) / "plain", 1 << 24 if asked.tiny else 0)
        records = [store.verify(root, key, arrays=False) for key in store.keys(root)]
    frames = sum(record["length"] for record in records)
    stored = sum(file["bytes"] for r in records for file in r["files"].values())
    substeps = round(1 / env.control_hz / env.scene.mj_model.opt.timestep)
    c_s = frames * substeps / _c_mujoco.steps_per_s(env.scene)
    row = {
        "demonstrations": sum(record["success"] for record in records),
        "trials": len(records),
        "frames": frames,
        "bytes": stored,
        "chunk": asked.chunk,
        **spent,
        "compile_s": max(0.0, first_s - again_s),
        "c_physics_alone_s": c_s,
        "times_c_physics_speed": c_s / spent["run_s"],
        "plain_write_s": stored / plain_rate,
        "ratio_to_plain_write": spent["run_s"] / (stored / plain_rate),
    }
    print(
        f"{row['demonstrations']} demonstrations of {asked.image} px in {row['run_s']:.1f} s: "
        f"waiting {row['simulate_s']:.1f} for the simulation, {row['copy_s']:.1f} for pictures, "
        f"{row['write_s']:.1f} for the disk ({stored / 1e9:.2f} GB, plainly "
        f"{row['plain_write_s']:.1f}); compiling {row['compile_s']:.1f} s; "
        f"C MuJoCo's physics alone {c_s:.1f} s"
    )
    _timing.report("collect", {"results": {f"{asked.image} px": row}}, asked.tiny)


def seen(env: envs.Env) -> rcm.Trocar:
    """The configurations of trocars that demonstrations are collected at."""
    return trocars.select(env.task.trocars, slice(SEEN))


def collect(
    root: pathlib.Path,
    simulate: engine.Run,
    env: envs.Env,
    expert: agent.BatchAgent,
    asked: argparse.Namespace,
) -> dict:
    """Collects with programs that are compiled; its time and its waits."""
    begun, segments, fetches = [], [], []  # s; appended to by all threads
    fetch, chunks = fetching.fetch, []

    def begin(*_):
        begun.append(time.perf_counter())
        return timed_simulate

    def timed_simulate(params, group):
        chunks.append(len(group))
        simulation = simulate(params, group)
        while True:
            start = time.perf_counter()
            segment = next(simulation, None)
            segments.append(time.perf_counter() - start)
            if segment is None:
                return
            yield segment

    def timed_fetch(slices):
        start = time.perf_counter()
        fetched = fetch(slices)
        fetches.append(time.perf_counter() - start)
        return fetched

    settings = schema.DemoSettings(asked.per_trocar, seed=0, max_steps=MAX_STEPS)
    layout = placement.DeviceLayout(asked.chunk)
    with (
        mock.patch.object(engine, "make", begin),
        mock.patch.object(fetching, "fetch", timed_fetch),
    ):
        demos.collect(root, env, expert, seen(env), settings, layout=layout)
    run_s = time.perf_counter() - begun[0]
    simulated, copied = (sum(spent) / workers.worker_count() for spent in (segments, fetches))
    return {
        "chunks": chunks,
        "run_s": run_s,
        "simulate_s": simulated - copied,
        "copy_s": copied,
        "write_s": run_s - simulated,
    }


def plain_write(path: pathlib.Path, count: int) -> float:
    """Bytes a second of one file written from memory and synced."""
    data = np.random.default_rng(0).integers(0, 256, count or PLAIN_BYTES, np.uint8).data
    start = time.perf_counter()
    with open(path, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    return len(data) / (time.perf_counter() - start)


if __name__ == "__main__":
    main()
