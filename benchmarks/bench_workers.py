"""Control steps per second on a CPU: one program per core, against one for all of them.

    python benchmarks/bench_workers.py [--image 128] [--tiny]

The scripted expert in the programs that collect demonstrations, compiled beforehand.
"""

import argparse
from collections.abc import Generator

import _timing
import _visited

from starjax import runtime
from starjax.data import schema
from starjax.sim import env as envs
from starjax.sim.rollouts import agent, engine, episodes, workers

SEGMENTS = 8  # control steps of a measurement: 4 s simulated, in which no episode ends


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--image", type=int, default=128, help="side in pixels")
    parser.add_argument("--tiny", action="store_true", help="a test's sizes, nothing is written")
    asked = parser.parse_args()
    runtime.prepare_xla()
    side, segments = (16, 1) if asked.tiny else (asked.image, SEGMENTS)
    env = envs.make(image_size=side)
    rows = {}
    for name, lanes, max_workers in (
        ("one program", _visited.CPU_LANES, 1),
        ("one program, fewer lanes", workers.CPU_LANES, 1),
        ("one per core", workers.CPU_LANES, workers.worker_count()),
    ):
        rows[name] = measure(env, lanes, max_workers, segments)
        rows[name]["times_one_program"] = (
            rows[name]["control_steps_per_s"] / rows["one program"]["control_steps_per_s"]
        )
        print(
            f"{name:24} {max_workers} x {lanes:2} lanes: "
            f"{rows[name]['control_steps_per_s']:.0f} control steps/s, "
            f"{rows[name]['times_one_program']:.2f} times one program's",
            flush=True,
        )
    _timing.report("workers", {"results": {f"{side} px": rows}}, asked.tiny)


def measure(env: envs.Env, lanes: int, max_workers: int, segments: int) -> dict:
    """Rate of `max_workers` simulations of `lanes` episodes each."""
    trocars, record = env.task.trocars, episodes.DEMONSTRATION
    steps, configurations = segments * record.frames, len(trocars.radius)
    rules = engine.RolloutSettings(0, schema.STREAM, steps, lanes)
    expert = agent.from_single(_visited.expert(env))
    simulation = engine.make(env, expert, trocars, rules, record)

    def simulate(number: int) -> Generator[int]:
        group = [(lane % configurations, number * lanes + lane) for lane in range(lanes)]
        for segment in simulation(None, group):
            yield len(segment.ended)

    def run() -> None:
        sum(workers.run(range(max_workers), simulate, max_workers))

    timing = _timing.time_plain(run, repeats=3)
    return {
        "lanes": lanes,
        "at_once": max_workers,
        "control_steps_per_s": max_workers * lanes * steps / timing.median_s,
    }


if __name__ == "__main__":
    main()
