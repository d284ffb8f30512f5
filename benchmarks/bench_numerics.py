"""bfloat16 against float32: the same seeds, data and steps; how far apart the loss curves run.

    python benchmarks/bench_numerics.py [--steps 500] [--crop 96] [--tiny]

Parameters, statistics and losses are float32 in both; only the networks' arithmetic differs. The
losses are smoothed by an exponential average over 50 steps, since each is a draw of noise; against
their largest relative difference stands that of two float32 runs with other seeds, which is how far
apart curves run that differ in nothing that matters.
"""

import argparse

import _peer
import _setup
import _timing
import jax
import jax.numpy as jnp
import numpy as np

from starjax import runtime

SMOOTH = 50  # steps
SKIP = 100  # steps at the start, where everything falls fast


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--crop", type=int, default=96, help="of the paper's model, on a GPU")
    parser.add_argument("--tiny", action="store_true", help="a test's sizes, nothing is written")
    asked = parser.parse_args()
    runtime.prepare_xla()
    runs = {"float32": ("float32", 0), "bfloat16": ("bfloat16", 0), "other seed": ("float32", 1)}
    smooth, skip = (2, 1) if asked.tiny else (SMOOTH, min(SKIP, asked.steps // 2))
    curves = {}
    for name, (dtype, seed) in runs.items():
        curves[name] = losses(settings(asked, dtype), seed, 4 if asked.tiny else asked.steps)
        print(f"{name}: last loss {smoothed(curves[name], smooth)[-1]:.4f}", flush=True)
    apart = {
        name: difference(curves["float32"], curves[name], smooth)[skip:].max()
        for name in ("bfloat16", "other seed")
    }
    for name, value in apart.items():
        print(f"float32 and {name}: smoothed losses differ by at most {value:.2%}")
    row = {
        "steps": asked.steps,
        "largest_difference_bfloat16": float(apart["bfloat16"]),
        "largest_difference_other_seed": float(apart["other seed"]),
        "every": max(1, asked.steps // 50),
        **{
            f"losses {name}": smoothed(curve, smooth)[:: max(1, asked.steps // 50)].tolist()
            for name, curve in curves.items()
        },
    }
    _timing.report("numerics", {"results": {f"{asked.crop} px": row}}, asked.tiny)


def settings(asked: argparse.Namespace, dtype: str) -> _setup.Case:
    """The paper's model on a GPU, a small one of pictures elsewhere."""
    if asked.tiny:
        case = _setup.miniature()
    elif _peer.platform() == "gpu":
        return _setup.paper(asked.crop, dtype=dtype)
    else:
        case = _setup.small(32, 64)
    return case._replace(policy=_setup.dataclasses.replace(case.policy, dtype=dtype))


def losses(case: _setup.Case, seed: int, steps: int) -> np.ndarray:
    """`[steps]` losses, one a step."""
    job = _setup.job(case, seed=seed, frames=256)

    def step(carry, dataset):
        cleared = carry.state.replace(sums=jax.tree.map(jnp.zeros_like, carry.state.sums))
        return job.steps(carry._replace(state=cleared), dataset, jnp.int32(1))

    one = jax.jit(step, donate_argnums=0)
    carry, found = job.carry, []
    for _ in range(steps):
        carry = one(carry, job.dataset)
        # Copied, as the next step takes the state's memory; not waited for.
        found.append(jnp.copy(carry.state.sums["loss"]))
    return np.array(jax.device_get(found))


def smoothed(curve: np.ndarray, over: int) -> np.ndarray:
    """Exponential average, corrected for its start."""
    kept, total, out = 1.0 - 1.0 / over, 0.0, []
    for i, value in enumerate(curve):
        total = kept * total + (1.0 - kept) * value
        out.append(total / (1.0 - kept ** (i + 1)))
    return np.array(out)


def difference(a: np.ndarray, b: np.ndarray, over: int) -> np.ndarray:
    """Relative difference of two smoothed curves."""
    a, b = smoothed(a, over), smoothed(b, over)
    return np.abs(a - b) / np.abs(a)


if __name__ == "__main__":
    main()
