"""Collecting demonstrations: 240 of them, 256 x 256 pixels, 30 Hz; and how much of it is writing.

    python benchmarks/bench_collect.py [--image 256] [--per-trocar 30] [--folder DIR] [--tiny]

The same programs and the same files as `starjax collect`: a wave of trials at the eight seen
trocars, then as many as failed. The first wave is simulated once before the clock starts, which
compiles; compilation is the difference. Beside it: one thread of C MuJoCo doing the physics steps
alone, and for the writing a plain sequential write with fsync in the same folder.
"""

import argparse
import concurrent.futures
import os
import pathlib
import tempfile
import time

import _c_mujoco
import _peer
import _timing
import numpy as np

from starjax import rcm, runtime
from starjax.data import demos, recorder, store
from starjax.sim import env as envs
from starjax.sim.tasks import expert

SEEN = 8
MAX_STEPS = 600
PLAIN_BYTES = 1 << 30
GPU_CHUNK = 256  # as `demos.collect`


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    small = _peer.platform() == "cpu"
    parser.add_argument("--image", type=int, default=64 if small else 256)
    parser.add_argument("--per-trocar", type=int, default=2 if small else 30)
    parser.add_argument("--chunk", type=int, default=16 if small else GPU_CHUNK)
    parser.add_argument("--folder", help="where a temporary folder is made; default: the system's")
    parser.add_argument("--tiny", action="store_true", help="a test's sizes, nothing is written")
    asked = parser.parse_args()
    runtime.prepare_xla()
    if asked.tiny:
        asked.image, asked.per_trocar, asked.chunk = 16, 1, SEEN
    env = envs.make("image", asked.image)
    trocars = rcm.Trocar(*(np.asarray(field[:SEEN], np.float32) for field in rcm.TROCARS))
    trocar, trial = np.divmod(np.arange(SEEN * asked.per_trocar), asked.per_trocar)
    wave = list(zip(trocar.tolist(), trial.tolist()))
    simulate = recorder.simulator(env, expert, trocars, 0, MAX_STEPS, asked.chunk, None)

    start = time.perf_counter()
    simulate(wave[: asked.chunk])
    first_s = time.perf_counter() - start
    with tempfile.TemporaryDirectory(dir=asked.folder) as folder:
        spent = {"simulate": [], "write": []}
        records = collect(simulate, wave, asked, pathlib.Path(folder), spent)
        plain_rate = plain_write(pathlib.Path(folder) / "plain", 1 << 24 if asked.tiny else 0)
    frames = sum(record["length"] for record in records)
    stored = sum(file["bytes"] for r in records for file in r["files"].values())
    simulate_s, write_s = sum(spent["simulate"]), sum(spent["write"])
    substeps = round(1 / env.control_hz / env.model.mj_model.opt.timestep)
    c_s = frames * substeps / _c_mujoco.steps_per_s(env.model)
    row = {
        "demonstrations": sum(record["success"] for record in records),
        "trials": len(records),
        "frames": frames,
        "bytes": stored,
        "chunk": asked.chunk,
        "run_s": simulate_s + write_s,
        "simulate_s": simulate_s,
        "simulate_chunks_s": spent["simulate"],
        "write_s": write_s,
        "compile_s": max(0.0, first_s - spent["simulate"][0]),
        "c_physics_alone_s": c_s,
        "times_c_physics_speed": c_s / (simulate_s + write_s),
        "plain_write_s": stored / plain_rate,
        "write_ratio_to_plain": write_s / (stored / plain_rate),
    }
    print(
        f"{row['demonstrations']} demonstrations of {asked.image} px in {row['run_s']:.1f} s: "
        f"simulating {simulate_s:.1f}, hashing and writing {stored / 1e9:.2f} GB {write_s:.1f} "
        f"(plainly {row['plain_write_s']:.1f}); compiling {row['compile_s']:.1f} s; "
        f"C MuJoCo's physics alone {c_s:.1f} s"
    )
    _timing.report("collect", {"results": {f"{asked.image} px": row}}, asked.tiny)


def collect(simulate, wave, asked, folder: pathlib.Path, spent: dict) -> list[store.Record]:
    """Simulates and commits chunk by chunk, wave by wave; appends to `spent` seconds."""
    records, drawn = [], [asked.per_trocar] * SEEN
    with concurrent.futures.ThreadPoolExecutor(demos.COMMITS) as pool:
        while wave:
            failed = []
            for group in (wave[i : i + asked.chunk] for i in range(0, len(wave), asked.chunk)):
                start = time.perf_counter()
                episode = simulate(group)
                spent["simulate"].append(time.perf_counter() - start)
                start = time.perf_counter()

                def commit(lane: int, episode=episode) -> store.Record:
                    outcome, arrays = episode(lane)
                    key = store.key(outcome["trocar"], outcome["trial"], 0)
                    return store.commit(folder, key, outcome, arrays if outcome["success"] else {})

                done = list(pool.map(commit, range(len(group))))
                spent["write"].append(time.perf_counter() - start)
                records += done
                failed += [record["trocar"] for record in done if not record["success"]]
            wave = []
            for trocar in failed:
                wave.append((trocar, drawn[trocar]))
                drawn[trocar] += 1
    return records


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
