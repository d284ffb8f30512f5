"""Training steps with disturbances: time, against the same steps without.

    python benchmarks/bench_redraw.py [--tiny]

The policy and batch are those of preset `compact`. "images" has the disturbances that are functions
of an image, "all" also displaced cameras, delays and lost observations, "look" also that of a body
cavity. The cases alternate.
Memory is the device's highest use in a case's first steps, without the dataset and other cases.
"""

import argparse
import dataclasses
import statistics
import time
from collections.abc import Callable
from typing import Any

import _setup
import _timing
import jax
import jax.numpy as jnp
import numpy as np

from starjax import runtime
from starjax.cli import presets
from starjax.data import redraw
from starjax.sim import env as envs
from starjax.sim.state import EnvParams, ImageSource
from starjax.training import batches, devices, redrawing, state, step
from starjax.training.sharding import Setup, StateLayout

IMAGES = ("darkness=0.5", "tint=0.4", "smoke=0.5", "blood=0.2", "blur=2", "noise=0.1")
OTHERS = ("camera=10", "observation_delay=4", "observation_dropout=0.5")
ALL = (*OTHERS, *IMAGES)
CASES = {"none": (), "images": IMAGES, "all": ALL, "look": (*ALL, "look=1")}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=200, help="of a case in a round")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--tiny", action="store_true", help="a test's sizes, nothing is written")
    asked = parser.parse_args()
    runtime.prepare_xla()
    preset = presets.PRESETS["compact"]
    case = _setup.miniature() if asked.tiny else _setup.Case(preset.policy, preset.train)
    steps, rounds = (2, 1) if asked.tiny else (asked.steps, asked.rounds)
    env, both = (
        envs.make(
            "peg_transfer",
            image_size=case.policy.image_size,
            moving_cameras=True,
            varying_look=varies,
        )
        for varies in (False, True)
    )
    dataset = _setup.made_up(case.policy, 64 if asked.tiny else 16_384)
    dataset = jax.device_put(dataset.replace(sources=sources(env, len(dataset.episode))))
    runs: dict[str, Callable] = {}
    bytes_used = {}
    for name, names in CASES.items():
        before = memory("bytes_in_use")
        draw = both.draw if name == "look" else env.draw
        runs[name] = make(case, names, dataset, draw)
        runs[name](steps)  # compiles
        # The cases grow, and each starts from the memory of the others: its peak is the highest.
        bytes_used[name] = memory("peak_bytes_in_use") - before
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(rounds):
        for name, run in runs.items():
            start = time.perf_counter()
            run(steps)
            seconds[name].append((time.perf_counter() - start) / steps)
    plain = statistics.median(seconds["none"])
    results = {}
    print("disturbances  steps/s  of plain  memory (MB)")
    for name, times in seconds.items():
        pace, memory_mb = 1.0 / statistics.median(times), bytes_used[name] / 1e6
        results[name] = {"steps_per_s": pace, "fastest": 1.0 / min(times), "of_plain": pace * plain}
        results[name]["memory_mb"] = memory_mb
        print(f"{name:13} {pace:7.1f} {pace * plain:9.2f} {memory_mb:12.0f}", flush=True)
    held = {"images": dataset.observation.images, "others": dataset.replace(observation=None)}
    facts = {
        "batch": case.train.batch_size,
        "device": str(jax.devices()[0].device_kind),
        "bytes_per_frame": {
            name: sum(leaf.nbytes for leaf in jax.tree.leaves(part)) / len(dataset.episode)
            for name, part in held.items()
        },
    }
    _timing.report("redraw", {**facts, "results": results}, asked.tiny)


def make(case: _setup.Case, names: tuple[str, ...], dataset: Any, draw: Any) -> Callable:
    """Makes the function that takes steps with these disturbances, and waits for the last."""
    case = case._replace(train=dataclasses.replace(case.train, randomise=names))
    policy = _setup.policies.make(_setup.METHOD, case.policy, _setup.TASK, case.train)
    optimizer, key = state.make_optimizer(case.train), state.streams(0).steps
    first = state.create(
        policy, optimizer, _setup.drawn(policy), _setup.statistics(case.policy), key
    )
    mesh = devices.make_mesh(case.train.batch_size, jax.devices()[:1])
    layout = StateLayout(mesh, policy.cast_params, jax.eval_shape(lambda x: x, first))
    setup = Setup(policy, optimizer, case.policy, case.train, layout)
    draws = draw if "camera=10" in names else None
    frames = np.arange(len(dataset.episode), dtype=np.int32)
    data = batches.on_devices(setup, dataset, frames)
    displace = redrawing.make(setup, draws, data, ahead=False)
    begun = devices.replicate(first, mesh)
    stream = batches.resident(setup, data, jnp.copy(begun.key), 0, displace)
    program, carry = step.batch_program(setup), layout.to_carry(begun)

    def run(count: int) -> None:
        nonlocal carry
        for _ in range(count):
            carry = program(carry, next(stream))
        jax.block_until_ready(carry)

    return run


def memory(name: str) -> int:
    """Returns a number of the device's memory statistics, 0 on a CPU."""
    return (jax.devices()[0].memory_stats() or {}).get(name, 0)


def sources(env: envs.Env, count: int) -> redraw.Sources:
    """Starts of one episode, whose joints differ from frame to frame as they do at reset."""
    trocar = jax.tree.map(lambda field: field[0], env.task.trocars)
    reset = jax.jit(jax.vmap(lambda key: env.reset(key, EnvParams(trocar))))
    states = reset(jax.random.split(jax.random.key(0), 32))
    first = jax.tree.map(lambda leaf: leaf[:1], states)
    still = jnp.zeros((1, 0))
    episodes = ImageSource(still, first.trocar.p_world_trocar, first.layout, first.cameras)
    return redraw.Sources(states.physics.qpos[np.arange(count) % 32], episodes)


if __name__ == "__main__":
    main()
