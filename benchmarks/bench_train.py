"""Training samples per second on this machine, against the time of the arithmetic alone.

    python benchmarks/bench_train.py [--only state]

The floor is what the multiplications of one step would take at the rate of a large matrix product
timed in the same process, plus what AdamW and the average must read and write at the rate of a
large copy: no framework can be faster without doing less.
"""

import argparse
import dataclasses

import _arithmetic
import _timing
import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm, runtime
from starjax.config import PolicyConfig, TrainConfig
from starjax.data import normalizer, windows
from starjax.evaluation import latency
from starjax.experiments.methods import METHODS
from starjax.policies import policy as policies
from starjax.training import devices, state, step
from starjax.types import Command

P_WORLD_REF = np.array([0.0, 0.0, 0.15], np.float32)
FRAMES = 512
STATE_PASSES = 9  # of AdamW and the average: gradient, and in and out of p, m, v, average

SMALL = PolicyConfig(
    observation="state",
    encoder="small",
    vision_dim=128,
    unet_channels=(64, 128, 256),
    time_dim=64,
)
CASES = {
    "state": (SMALL, 256),
    "state batch 64": (SMALL, 64),
    "image 64 px": (dataclasses.replace(SMALL, observation="image", image_size=64), 64),
    "image 96 px": (dataclasses.replace(SMALL, observation="image", image_size=96), 64),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="cases whose name contains this")
    only = parser.parse_args().only
    runtime.prepare_xla()
    flops, bandwidth = machine()
    print(f"matrix products {flops / 1e9:.0f} GFLOP/s, copies {bandwidth / 1e9:.1f} GB/s")
    print("case              samples/s  ms a step  floor ms  x floor  parameters  compile s")
    rows = {}
    for name, (policy_config, batch) in CASES.items():
        if only in name:
            row = measure(policy_config, batch, flops, bandwidth)
            rows[name] = row
            print(
                f"{name:17} {row['samples_per_s']:9.0f} {row['ms']:10.1f} {row['floor_ms']:9.1f} "
                f"{row['ratio_to_floor']:8.2f} {row['parameters'] / 1e6:9.2f} M "
                f"{row['compile_s']:9.1f}"
            )
    if not only:
        machine_rates = {"matmul_flop_per_s": flops, "copy_bytes_per_s": bandwidth}
        print(f"wrote {_timing.write('train', {**machine_rates, 'results': rows})}")


def measure(policy_config: PolicyConfig, batch: int, flops: float, bandwidth: float) -> dict:
    """One method (stardiff), dataset resident on the device."""
    train_config = TrainConfig(batch_size=batch)
    method = METHODS["stardiff"]
    policy = policies.make(method, policy_config, P_WORLD_REF, train_config)
    optimizer = state.make_optimizer(train_config)
    dataset = frames(policy_config)
    box = normalizer.MinMax(-jnp.ones(5), jnp.ones(5))
    wide = normalizer.MinMax(-jnp.ones(12), jnp.ones(12))
    stats = normalizer.Normalizer(box, wide if policy_config.observation == "state" else None)
    example = windows.gather(
        dataset, jnp.arange(batch), policy_config.obs_horizon, policy_config.horizon
    )
    first = state.create(policy, optimizer, state.init_params(policy, 0), stats, example, seed=0)
    mesh = devices.make_mesh(batch, jax.devices()[:1])

    settings = (policy, optimizer, policy_config, train_config, mesh)
    looped = step.runs_in_a_loop(policy_config, mesh)
    count = 10 if looped else 1

    def steps(first, dataset, count):
        drawn = jnp.arange(FRAMES)
        if looped:
            return step.resident_steps(*settings, first, dataset, drawn, count).params
        return step.resident_step(*settings, first, dataset, drawn).params

    timing = _timing.time_jitted(steps, first, dataset, jnp.int32(count), repeats=3)
    seconds = timing.min_s / count
    parameters = sum(leaf.size for leaf in jax.tree.leaves(first.params))
    gradient = jax.grad(policy.loss, has_aux=True)
    work = _arithmetic.operations(gradient, first.params, stats, jax.random.key(0), example)
    floor = work / flops + STATE_PASSES * 4 * parameters / bandwidth
    return {
        "batch": batch,
        "samples_per_s": batch / seconds,
        "ms": 1e3 * seconds,
        "floor_ms": 1e3 * floor,
        "ratio_to_floor": seconds / floor,
        "gflop_a_step": work / 1e9,
        "parameters": parameters,
        "compile_s": timing.compile_s,
    }


def frames(policy_config: PolicyConfig) -> windows.Dataset:
    """One long demonstration; what is in it does not change the time."""
    observation, _ = latency.example(policy_config, P_WORLD_REF, FRAMES)
    observation = jax.tree.map(lambda leaf: leaf[:, 0], observation)
    return windows.Dataset(
        observation=observation,
        command=Command(observation.pose, observation.gripper),
        trocar=jax.tree.map(lambda leaf: jnp.asarray(leaf[:1]), rcm.TROCARS),
        episode=jnp.zeros(FRAMES, jnp.int32),
        start=jnp.zeros(1, jnp.int32),
        length=jnp.full(1, FRAMES, jnp.int32),
    )


def machine() -> tuple[float, float]:
    """Rates of a large float32 matrix product (FLOP/s) and of a large copy (bytes/s, both ways)."""
    n = 1024
    a = jnp.ones((n, n))
    product = _timing.time_jitted(lambda a: a @ a, a, repeats=9)
    x = jnp.ones(1 << 24)
    copy = _timing.time_jitted(lambda x: x + 1.0, x, repeats=9)
    return 2 * n**3 / product.min_s, 2 * x.nbytes / copy.min_s


if __name__ == "__main__":
    main()
