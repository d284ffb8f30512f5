"""Time of one policy call (Table IV): DDIM steps, batch 1 and 24, the roll network's share.

    python benchmarks/bench_inference.py [--seconds 2]

The peer is numpy doing nothing but the matrix products of the same call on the same cores.
"""

import argparse
import dataclasses

import _arithmetic
import _timing
import jax
import jax.numpy as jnp
import numpy as np

from starjax import runtime
from starjax.config import PolicyConfig, TrainConfig
from starjax.data import normalizer
from starjax.evaluation import latency
from starjax.experiments.methods import METHODS
from starjax.policies import policy as policies
from starjax.training import state

P_WORLD_REF = np.array([0.0, 0.0, 0.15], np.float32)
METHOD = METHODS["stardiff"]
SETTINGS = PolicyConfig(
    observation="state",
    encoder="small",
    vision_dim=128,
    unet_channels=(64, 128, 256),
    time_dim=64,
)
CASES = {1: latency.DDIM_STEPS, 24: (10,)}  # batch: DDIM steps


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=1.0, help="of timed calls a row")
    seconds = parser.parse_args().seconds
    runtime.prepare_xla()
    policy = policies.make(METHOD, SETTINGS, P_WORLD_REF, TrainConfig())
    params = state.init_params(policy, 0)
    box = normalizer.MinMax(-jnp.ones(5), jnp.ones(5))
    wide = normalizer.MinMax(-jnp.ones(12), jnp.ones(12))
    stats = normalizer.Normalizer(box, wide)
    rows = []
    for batch, ddim_steps in CASES.items():
        rows += latency.table(
            METHOD,
            SETTINGS,
            TrainConfig(),
            params,
            stats,
            P_WORLD_REF,
            ddim_steps=ddim_steps,
            batches=[batch],
            seconds=seconds,
        )
    print("batch  DDIM steps      p50      p95      p99 ms  numpy ms  x numpy")
    for row in rows:
        row["numpy_ms"] = numpy_ms(params, stats, row["batch"], row["ddim_steps"])
        row["ratio_to_numpy"] = row["p50"] / row["numpy_ms"]
        print(
            f"{row['batch']:5} {row['ddim_steps']:11} {row['p50']:8.2f} {row['p95']:8.2f} "
            f"{row['p99']:8.2f} {row['numpy_ms']:9.2f} {row['ratio_to_numpy']:8.2f}"
        )
    roll = {str(batch): latency.roll_ms(SETTINGS, batch=batch) for batch in CASES}
    for batch, times in roll.items():
        print(f"roll network, batch {batch}: p50 {times['p50']:.3f} ms, p99 {times['p99']:.3f} ms")
    results = {"method": "stardiff", "rows": rows, "roll_network_ms": roll}
    print(f"wrote {_timing.write('inference', results)}")


def numpy_ms(params, stats, batch: int, ddim_steps: int) -> float:
    """All matrix products of a policy call, done by numpy."""
    settings = dataclasses.replace(SETTINGS, ddim_steps=ddim_steps)
    policy = policies.make(METHOD, settings, P_WORLD_REF, TrainConfig())
    observation, trocar = latency.example(SETTINGS, P_WORLD_REF, batch)
    keys = jax.random.split(jax.random.key(0), batch)
    found = _arithmetic.products(policy.sample, params, stats, keys, observation, trocar)
    pairs = [
        (np.ones((m, k), np.float32), np.ones((k, n), np.float32), times)
        for m, k, n, times in found
    ]

    def multiply() -> None:
        for left, right, times in pairs:
            for _ in range(times):
                left @ right

    return 1e3 * _timing.time_plain(multiply, repeats=5).min_s


if __name__ == "__main__":
    main()
