"""Several devices: train step and evaluation at a fixed batch for each, on 1, 2 and 4 of them.

    python benchmarks/bench_scaling.py [--devices 1 2 4] [--processes 2] [--tiny]

Efficiency is the time on one device over the time on n that do n times the work. `--processes P`
times the train step alone, once in one process on one device and once in P processes joined by
`jax.distributed`, the machine's devices split among them, as `starjax train` does when
JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES and JAX_PROCESS_ID are set.
"""

import argparse
import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator

import _peer
import _setup
import _timing
import bench_evaluate
import jax
import numpy as np

from starjax import runtime
from starjax.runtime import processes
from starjax.sim import env as envs

BATCH = 256  # a device
LANES = {"gpu": 360, "cpu": 4}  # trials per device
LIMIT_S = 4.0  # simulated, of a trial


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--devices", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--processes", type=int, default=0)
    parser.add_argument("--only", choices=["train", "evaluate"])
    parser.add_argument("--tiny", action="store_true", help="a test's sizes, nothing is written")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.tiny and not asked.processes and not asked.child:
        flags = os.environ.get("XLA_FLAGS", "")
        os.environ["XLA_FLAGS"] = f"{flags} --xla_force_host_platform_device_count=2".strip()
    runtime.prepare_xla()
    if asked.child:
        return child(asked)
    for name, row in between_processes(asked) if asked.processes else within_one(asked):
        _timing.report("scaling", {"results": {name: row}}, asked.tiny)


def within_one(asked: argparse.Namespace) -> Iterator[tuple[str, dict]]:
    """Rows of this process on its first n devices; one is always among them, to compare with."""
    times = {}
    counts = sorted({1, *(n for n in asked.devices if n <= len(jax.devices()))})
    for left in sorted(set(asked.devices) - set(counts)):
        print(f"{left} devices: not here, {len(jax.devices())} are")
    work = {"train": train, "evaluate": evaluate}
    for name in [asked.only] if asked.only else work:
        for count in counts:
            row = work[name](count, asked.tiny)
            times.setdefault(name, row["seconds"])
            title = f"{name}, {count} devices"
            yield title, told(title, row, times[name])


def told(name: str, row: dict, alone: float) -> dict:
    """The row with its efficiency, printed."""
    row["efficiency"] = alone / row["seconds"]
    print(f"{name}: {1e3 * row['seconds']:.2f} ms, efficiency {row['efficiency']:.1%}", flush=True)
    return row


def train(count: int, tiny: bool) -> dict:
    """One step at `BATCH` a device; in several processes `count` is of them all."""
    case = _setup.paper(96, BATCH * count)
    if tiny or _peer.platform() == "cpu":
        case = _setup.miniature(4 * count)
    job = _setup.job(case, jax.devices()[:count])
    steps = np.int32(job.per_call)
    timing, _ = _timing.time_carried(
        job.steps, job.carry, job.dataset, steps, calls=job.calls, **job.options
    )
    seconds = timing.median_s / (job.calls * job.per_call)
    return {"seconds": seconds, "batch": case.train.batch_size, "compile_s": timing.compile_s}


def evaluate(count: int, tiny: bool) -> dict:
    """An evaluation of `LANES` trials per device that all run to the limit."""
    platform = _peer.platform()
    case = _setup.paper(96) if platform == "gpu" and not tiny else _setup.miniature()
    policy, params, stats = _setup.untrained(case)
    env = envs.make(image_size=case.policy.image_size)
    limit = round((0.3 if tiny else LIMIT_S) * env.control_hz)
    lanes, given = LANES[platform] * count, (params, stats)
    on = jax.devices()[:count]
    run = bench_evaluate.runner(env, policy, case.policy, limit, lanes, on)
    trials = bench_evaluate.listed(env, -(-lanes // len(env.task.is_seen)))[:lanes]
    idle = bench_evaluate.over_at_once(env)
    compiling = _timing.time_once(lambda: list(run(given, idle)))
    timing = _timing.time_plain(lambda: list(run(given, trials)), repeats=2)
    return {"seconds": timing.min_s, "trials": lanes, "compile_s": compiling}


def between_processes(asked: argparse.Namespace) -> Iterator[tuple[str, dict]]:
    """Rows of the train step in one process, and in several."""
    total = asked.processes
    if _peer.platform() == "gpu":
        # Not asked of jax: a device that the children need must not be taken before them.
        listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, check=True)
        total = len(listed.stdout.splitlines())
    alone = launch(asked, 1, 1)
    together = launch(asked, asked.processes, total)
    names = (
        "train, one process, 1 devices",
        f"train, {asked.processes} processes, {total} devices",
    )
    for name, row in zip(names, (alone, together)):
        yield name, told(name, row, alone["seconds"])


def launch(asked: argparse.Namespace, count: int, total: int) -> dict:
    """The row of a train step of `count` processes that share `total` devices."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    command = [sys.executable, __file__, "--child", "--devices", str(total)]
    command += ["--tiny"] if asked.tiny else []
    started, share = [], total // count
    for index in range(count):
        environment = {
            **os.environ,
            "CUDA_VISIBLE_DEVICES": ",".join(map(str, range(index * share, (index + 1) * share))),
            "JAX_COORDINATOR_ADDRESS": f"localhost:{port}",
            "JAX_NUM_PROCESSES": str(count),
            "JAX_PROCESS_ID": str(index),
        }
        started.append(
            subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
        )
    said = [process.communicate()[0] for process in started]
    if any(process.returncode for process in started):
        sys.exit(f"{count} processes: one of them failed")
    return json.loads(said[0].splitlines()[-1])


def child(asked: argparse.Namespace) -> None:
    """One process of several."""
    processes.join()
    print(json.dumps(train(asked.devices[0], asked.tiny)))


if __name__ == "__main__":
    main()
