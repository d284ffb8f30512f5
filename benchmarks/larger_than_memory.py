"""Training on imported images larger than memory: steps per second, memory over time.

    python benchmarks/larger_than_memory.py OUT --gb 4 --seconds 300

Start it under a memory limit, for example `systemd-run --user --scope -p MemoryMax=1500M`. It
imports invented recordings of OUT/demos' size through the import's own code, trains a small image
policy on them with `starjax train`, and samples the memory of that process. Without a limit, the
same command has the dataset resident: the peer. `--processes 2` trains one policy in two processes.
"""

import argparse
import collections
import contextlib
import json
import os
import pathlib
import re
import signal
import socket
import subprocess
import sys
import time

import _timing
import numpy as np

from starjax.addons.formats import foreign
from starjax.addons.formats.base import Column, Source
from starjax.addons.formats.mapping import ArmColumns, CameraColumn, Map
from starjax.runtime import xla
from starjax.training import log as training_log

SIZE, STEPS, HZ = 128, 300, 30  # side in pixels, control steps of an episode, per second
SAMPLE_S = 5.0
_LINE = re.compile(r"(Rss\w+|VmHWM):\s+(\d+) kB")


def source(gigabytes: float) -> Source:
    """Returns invented recordings: a straight tool about a trocar, images of noise."""
    episodes = max(4, round(gigabytes * 1e9 / (STEPS * SIZE * SIZE * 3)))

    def read(episode: int, names) -> dict[str, np.ndarray]:
        random = np.random.default_rng(episode)
        times = np.arange(STEPS) / HZ + 3.0 * episode
        tip = np.stack([0.03 * np.sin(times), 0.03 * np.cos(0.7 * times), 0.02 + 0 * times], -1)
        z = tip - [0.0, 0.0, 0.18]
        z /= np.linalg.norm(z, axis=-1, keepdims=True)
        x = np.cross([0.0, 1.0, 0.0], z)
        x /= np.linalg.norm(x, axis=-1, keepdims=True)
        R = np.stack([x, np.cross(z, x), z], -1).reshape(STEPS, 9)
        arrays = {"pose": np.concatenate([tip, R], -1).astype(np.float32)}
        if "image" in names:
            arrays["image"] = random.integers(0, 255, (STEPS, SIZE, SIZE, 3), np.uint8)
        return {name: arrays[name] for name in names}

    columns = {"pose": Column((12,), "float32"), "image": Column((SIZE, SIZE, 3), "uint8")}
    return Source(HZ, [STEPS] * episodes, columns, read)


MAPPING = Map(
    task="peg_transfer",
    arms=(ArmColumns(position="pose[0:3]", rotation="pose[3:12]", rotation_as="matrix"),),
    cameras={"camera": CameraColumn(column="image")},
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--gb", type=float, default=4.0, help="images of the dataset")
    parser.add_argument("--seconds", type=float, default=300.0, help="of training")
    parser.add_argument("--processes", type=int, default=1, help="of one training, on this machine")
    asked = parser.parse_args()
    demos = asked.out / f"demos-{asked.gb:g}gb"
    if not (demos / "SEALED.json").exists():
        start = time.monotonic()
        foreign.import_mapped(source(asked.gb), MAPPING, demos, asked.out)
        print(f"imported {asked.gb:g} GB in {time.monotonic() - start:.0f} s", flush=True)
    run = asked.out / f"run-{os.getpid()}"
    rows, lines = trained(demos, run, asked.seconds, asked.processes)
    result = {
        "images_gb": asked.gb,
        "processes": asked.processes,
        "memory_limit_gb": round(xla.memory_bytes() / 1e9, 2),
        "residency": next((line for line in lines if "demonstrations," in line), ""),
        "steps_per_s": steps_per_second(rows),
        "memory_mb": rows,
    }
    print(json.dumps({**result, "memory_mb": rows[:: max(1, len(rows) // 12)]}, indent=1))
    place = "limited" if "disk" in result["residency"] else "resident"
    several = f"_{asked.processes}" if asked.processes > 1 else ""
    print(f"wrote {_timing.write(f'larger_than_memory_{place}{several}', result)}")


def trained(
    demos: pathlib.Path, run: pathlib.Path, seconds: float, processes: int
) -> tuple[list, list[str]]:
    """Trains for a time; returns samples of the processes' memory, and the first one's output."""
    command = [sys.executable, "-m", "starjax", "train", "--preset", "smoke", "--out", str(run)]
    command += ["--demos.from", str(demos), "--policy.observation", "image", "--method", "stardiff"]
    command += ["--policy.image-size", str(SIZE), "--train.steps", "1000000"]
    command += ["--train.log-every", "20", "--train.checkpoint-every", "1000000"]
    logs = [run.with_suffix(f".{number}.log") for number in range(processes)]
    with contextlib.ExitStack() as stack:
        started = []
        for number, environment in enumerate(environments(processes)):
            output = stack.enter_context(open(logs[number], "w"))
            started.append(subprocess.Popen(command, stdout=output, stderr=output, env=environment))
        start, rows, first = time.monotonic(), [], None
        while all(process.poll() is None for process in started):
            time.sleep(SAMPLE_S)
            metrics = next(run.rglob("metrics.jsonl"), None)
            steps = [row["step"] for row in training_log.read(metrics)] if metrics else []
            first = first or (time.monotonic() if steps else None)
            step = steps[-1] if steps else 0
            memory = sum(map(memory_mb, started), collections.Counter())
            if memory:  # none of processes that have just ended
                rows.append({"s": round(time.monotonic() - start), "step": step, **memory})
            if first and time.monotonic() - first > seconds:
                for process in started:
                    process.send_signal(signal.SIGTERM)
                break
        for process in started:
            process.wait()
    return rows, logs[0].read_text().splitlines()


def environments(processes: int) -> list[dict[str, str]]:
    """Returns the variables of each process of one training."""
    if processes == 1:
        return [dict(os.environ)]
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    shared = {"JAX_COORDINATOR_ADDRESS": address, "JAX_NUM_PROCESSES": str(processes)}
    return [{**os.environ, **shared, "JAX_PROCESS_ID": str(i)} for i in range(processes)]


def memory_mb(process: subprocess.Popen) -> collections.Counter:
    """Returns the process's memory by kind, as /proc calls them; none once it has ended."""
    try:
        status = pathlib.Path(f"/proc/{process.pid}/status").read_text()
    except OSError:
        status = ""
    return collections.Counter({name: int(kb) // 1024 for name, kb in _LINE.findall(status)})


def steps_per_second(rows: list[dict]) -> float | None:
    """Returns the rate between the first and the last logged step."""
    logged = [(row["s"], row["step"]) for row in rows if row["step"]]
    if len(logged) < 2 or logged[-1][0] == logged[0][0]:
        return None
    return round((logged[-1][1] - logged[0][1]) / (logged[-1][0] - logged[0][0]), 3)


if __name__ == "__main__":
    main()
