"""Time of one policy call (Table IV): encoder, DDIM, roll network; and the roll network's share.

    python benchmarks/bench_inference.py [--only "224 px"] [--peer [PYTHON]] [--tiny]
    python benchmarks/bench_inference.py --packaged

On a GPU: the paper's model from pictures, at batch 1 and 360, against PyTorch and the floor: the
larger of its arithmetic and of its weights in the networks' type, the U-Net's read once for each of
its evaluations, FiLM's and the encoder's once a call. On a CPU: a small model of the task's state,
for every count of DDIM steps, against numpy with the matrix products of the same call
on the same cores. `--packaged`: size of each packaged policy, time of its
decision, memory of a process.
"""

import argparse
import json
import subprocess
import sys

import _arithmetic
import _machine
import _peer
import _setup
import _timing
import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm, runtime
from starjax.addons.decisions import parallel_ddim
from starjax.cli import bench
from starjax.core import config
from starjax.evaluation import latency
from starjax.policies import features, packaged
from starjax.policies import policy as policies
from starjax.policies.models import roll_net

CHAIN = 100  # roll networks in one program, each fed by the one before
SEEN = features.select_sensors(_setup.TASK)

# name: case, batch, DDIM steps
CASES = {
    "gpu": {
        f"{crop} px batch {batch}": (_setup.paper(crop), batch, 10)
        for crop in (96, 224)
        for batch in (1, 360)
    },
    "cpu": {
        f"state batch {batch}, {steps} steps": (_setup.small(batch), batch, steps)
        for batch, counts in ((1, bench.DDIM_STEPS), (24, (10,)))
        for steps in counts
    },
    "tiny": {"48 px batch 2": (_setup.miniature(), 2, 10)},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="rows whose name contains this")
    parser.add_argument("--seconds", type=float, default=2.0, help="of timed calls a row")
    parser.add_argument("--tiny", action="store_true", help="a test's sizes, nothing is written")
    parser.add_argument("--packaged", action="store_true", help="packaged policies, see above")
    _peer.add_flag(parser)
    asked = parser.parse_args()
    runtime.prepare_xla()
    if asked.packaged:
        rows = {name: packaged_size(name) for name in packaged.names()}
        return _timing.report("packaged", rows, asked.tiny)
    cases = CASES["tiny" if asked.tiny else _peer.platform()]
    cases = {name: case for name, case in cases.items() if asked.only in name}
    # Before jax takes the device's memory.
    peers = {
        name: _peer.ask(
            asked.peer, "policy", "--crop", case.crop, "--batch", batch, tiny=asked.tiny
        )
        for name, (case, batch, _) in cases.items()
        if case.crop
    }
    rates = {c.policy.dtype: None for c, _, _ in cases.values()}
    rates = {dtype: _machine.measure(dtype) for dtype in rates}
    print("row                           p50      p95      p99 ms  floor ms  x floor  x peer")
    facts = {"method": "stardiff", **next(iter(rates.values())).facts()}

    def keep(name: str, row: dict) -> None:
        _timing.report("inference", {**facts, "results": {name: row}}, asked.tiny)

    for name, (case, batch, steps) in cases.items():
        case = case._replace(policy=config.with_options(case.policy, ddim_steps=steps))
        row = measure(case, batch, rates[case.policy.dtype], asked.seconds)
        row |= _peer.compared(peers.get(name, {}), row["p50"])
        speed = row.get("times_peer_speed", row.get("times_numpy_speed", float("nan")))
        print(
            f"{name:24} {row['p50']:8.2f} {row['p95']:8.2f} {row['p99']:8.2f} "
            f"{row['floor_ms']:12.2f} {row['ratio_to_floor']:8.2f} {speed:7.2f}",
            flush=True,
        )
        keep(name, row)
    settings = {batch: case.policy for case, batch, _ in cases.values()}
    for batch, policy_config in settings.items():
        row = roll_network(policy_config, batch)
        print(
            f"roll network, batch {batch}: {row['in_a_program_ms']:.4f} ms within a program, "
            f"called alone p50 {row['p50']:.3f} ms"
        )
        keep(f"roll network batch {batch}", row)


def measure(case: _setup.Case, batch: int, rates: _machine.Rates, seconds: float) -> dict:
    """Percentiles of one call, ms, and its floor."""
    policy, params, stats = _setup.untrained(case)
    times = latency.policy_ms(
        policy,
        case.policy,
        params,
        stats,
        SEEN,
        batch=batch,
        calls=200,
        seconds=seconds,
    )
    observation, trocar = latency.example(case.policy, SEEN, batch)
    told = rcm.trocar_frame(trocar, _setup.P_WORLD_REF)
    traced = (params, stats, jax.random.split(jax.random.key(0), batch), observation, told)
    work = _arithmetic.operations(policy.sample, *traced)
    sequences = batch
    steps = evaluations = case.policy.options.ddim_steps
    if parallel_ddim.pays(batch, steps):
        sequences, evaluations = batch * steps, parallel_ddim.evaluations_for(steps)
    work -= sequences * evaluations * _arithmetic.of_padding(case.policy)
    arithmetic_s = work / rates.flops
    reading_s = weights_read(params, case.policy, evaluations) / rates.bandwidth
    floor = max(arithmetic_s, reading_s)
    row = {
        "batch": batch,
        "ddim_steps": case.policy.options.ddim_steps,
        "evaluations": evaluations,
        **times,
        "floor_ms": 1e3 * floor,
        "floor_arithmetic_ms": 1e3 * arithmetic_s,
        "floor_reading_ms": 1e3 * reading_s,
        "ratio_to_floor": times["p50"] / (1e3 * floor),
    }
    if jax.default_backend() == "cpu" and not case.crop:
        row["numpy_ms"] = numpy_ms(policy, *traced)
        row["times_numpy_speed"] = row["numpy_ms"] / row["p50"]
    return row


def weights_read(params: policies.Params, policy_config, evaluations: int) -> float:
    """Bytes: those of each evaluation of the U-Net, and those needed once."""
    total = 0
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        name = jax.tree_util.keystr(path)
        again = "'unet'" in name and "film_" not in name and "'time_" not in name
        total += leaf.size * (evaluations if again else 1)
    return total * jnp.dtype(policy_config.dtype).itemsize


def packaged_size(name: str) -> dict[str, float]:
    """MB of a policy's file, ms of a decision, and peak MB of the process that makes them."""
    program = """
import json, resource, sys, time
import numpy as np
from starjax import deploy
from starjax.deploy import batching
batches = batching.Batches(deploy.load(sys.argv[1]), 1)
batches.warm_up()
times = []
for _ in range(100):
    begun = time.perf_counter()
    batches.infer([batching.example(batches.policy.input_spec)])
    times.append(1e3 * (time.perf_counter() - begun))
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(json.dumps({"decision_ms": float(np.median(times)), "memory_mb": peak}))
"""
    done = subprocess.run(
        [sys.executable, "-c", program, name], capture_output=True, text=True, check=True
    )
    row = {"mb": packaged.locate(name).stat().st_size / 1e6, **json.loads(done.stdout)}
    print(name, row, flush=True)
    return row


def numpy_ms(policy: policies.Policy, *traced) -> float:
    """All matrix products of a policy call, done by numpy."""
    pairs = [
        (np.ones((m, k), np.float32), np.ones((k, n), np.float32), times)
        for m, k, n, times in _arithmetic.products(policy.sample, *traced)
    ]

    def multiply() -> None:
        for left, right, times in pairs:
            for _ in range(times):
                left @ right

    return 1e3 * _timing.time_plain(multiply, repeats=5).min_s


def roll_network(policy_config, batch: int) -> dict:
    """Its time within a program, ms, and percentiles of calling it alone (mostly the call)."""
    net = roll_net.RollNet(
        width=policy_config.roll_width,
        blocks=policy_config.roll_blocks,
        dtype=jnp.dtype(policy_config.dtype),
    )
    p = jnp.zeros((batch, policy_config.horizon, 3))
    inputs = (p, jnp.zeros((batch, features.TROCAR_FEATURES)))
    history = jnp.zeros((batch, policy_config.obs_horizon))
    params = net.init(jax.random.key(0), *inputs, history)

    def chain(params, history):
        def one(_, history):
            return net.apply(params, *inputs, history)[:, : history.shape[1]]

        return jax.lax.fori_loop(0, CHAIN, one, history)

    within = _timing.time_jitted(chain, params, history).median_s / CHAIN
    return {"in_a_program_ms": 1e3 * within, **latency.roll_ms(policy_config, SEEN, batch=batch)}


if __name__ == "__main__":
    main()
