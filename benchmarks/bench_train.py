"""Training steps: time, against the arithmetic alone and against PyTorch.

    python benchmarks/bench_train.py [--only "96 px"] [--peer [PYTHON]] [--tiny]

The floor is the time of the multiplications of one step at the rate of a large matrix product timed
in the same process, plus that of the bytes of AdamW and the average at the rate of a large
copy: no framework can be faster without doing less. On a GPU the rows are the paper's model at two
sizes of crop, on a CPU small ones.
"""

import argparse

import _arithmetic
import _machine
import _peer
import _setup
import _timing
import jax
import numpy as np

from starjax import runtime

STATE_PASSES = 9  # bytes of AdamW and the average: gradient, and in and out of p, m, v, average

CASES = {
    "gpu": {"96 px": _setup.paper(96), "224 px": _setup.paper(224)},
    "cpu": {
        "state": _setup.small(256),
        "state batch 64": _setup.small(64),
        "image 64 px": _setup.small(64, 64),
        "image 96 px": _setup.small(64, 96),
    },
    "tiny": {"48 px": _setup.miniature()},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--tiny", action="store_true", help="a test's sizes, nothing is written")
    _peer.add_flag(parser)
    asked = parser.parse_args()
    runtime.prepare_xla()
    cases = CASES["tiny" if asked.tiny else _peer.platform()]
    cases = {name: case for name, case in cases.items() if asked.only in name}
    # Before jax takes the device's memory.
    peers = {
        name: _peer.ask(
            asked.peer,
            *("train", "--crop", case.crop, "--batch", case.train.batch_size),
            tiny=asked.tiny,
        )
        for name, case in cases.items()
        if asked.tiny or case.policy.encoder == "resnet18"
    }
    rates = {dtype: _machine.measure(dtype) for dtype in {c.policy.dtype for c in cases.values()}}
    print("\n".join(rate.described() for rate in rates.values()))
    print(
        "case              samples/s  ms a step  floor ms  x floor  x peer  parameters  compile s"
    )
    facts = next(iter(rates.values())).facts()
    for name, case in cases.items():
        row = measure(case, rates[case.policy.dtype])
        row |= _peer.compared(peers.get(name, {}), row["ms"])
        print(
            f"{name:17} {row['samples_per_s']:9.0f} {row['ms']:10.2f} {row['floor_ms']:9.2f} "
            f"{row['ratio_to_floor']:8.2f} {row.get('times_peer_speed', float('nan')):7.2f} "
            f"{row['parameters'] / 1e6:9.2f} M {row['compile_s']:9.1f}",
            flush=True,
        )
        _timing.report("train", {**facts, "results": {name: row}}, asked.tiny)


def measure(case: _setup.Case, rates: _machine.Rates) -> dict:
    """One method (stardiff), dataset resident on the device."""
    job = _setup.job(case)
    parameters = sum(leaf.size for leaf in jax.tree.leaves(job.params))
    gradient = jax.grad(job.policy.loss, has_aux=True)
    given = job.policy.prepare(job.carry.state.normalizer, jax.random.key(0), job.example)
    work = _arithmetic.operations(gradient, job.params, given)
    # Forward, and the gradients of inputs and of weights.
    work -= 3 * case.train.batch_size * _arithmetic.of_padding(case.policy)
    arithmetic_s = work / rates.flops
    floor = arithmetic_s + STATE_PASSES * 4 * parameters / rates.bandwidth
    count = np.int32(job.per_call)
    inputs = (job.carry, job.dataset, count)
    timing, _ = _timing.time_carried(job.steps, *inputs, calls=job.calls, **job.options)
    timed = job.calls * job.per_call
    seconds = timing.median_s / timed
    batch = case.train.batch_size
    return {
        "batch": batch,
        "samples_per_s": batch / seconds,
        "ms": 1e3 * seconds,
        "fastest_ms": 1e3 * timing.min_s / timed,
        "floor_ms": 1e3 * floor,
        "floor_arithmetic_ms": 1e3 * arithmetic_s,
        "ratio_to_floor": seconds / floor,
        "gflop_a_step": work / 1e9,
        "parameters": parameters,
        "compile_s": timing.compile_s,
        "temporary_gb": timing.temporary_bytes / 1e9,
    }


if __name__ == "__main__":
    main()
