"""How near DDIM whose steps are side by side comes to DDIM, after so many evaluations.

    starjax collect --preset compact --demos.per-trocar 2 --seed 77 --out runs/ddim
    python benchmarks/bench_ddim.py runs/ddim/demos-* [--policy compact] [--temperature 1] \\
        [--ddim-steps 100]

A policy plans at frames of demonstrations that it did not learn from, each way with the same noise;
with it, the difference of bfloat16 from float32, step after step and side by
side. No time is measured here: bench_inference.py does that.
"""

import argparse
import dataclasses
import functools
import pathlib
from collections.abc import Callable
from unittest import mock

import _timing
import jax
import jax.numpy as jnp
import numpy as np

from starjax import runtime
from starjax.addons.decisions import parallel_ddim
from starjax.core import config, methods
from starjax.core.types import Command
from starjax.data import load, windows
from starjax.policies import packaged, policy_file
from starjax.policies import policy as policies
from starjax.policies.models import diffusion
from starjax.sim import registries

FRAMES = 128
AROUND = range(-2, 4)  # evaluations, from as many as are used


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("demos", type=pathlib.Path)
    parser.add_argument("--policy", default="compact")
    parser.add_argument("--temperature", type=float, help="by default the policy's")
    parser.add_argument("--ddim-steps", type=int, help="by default the policy's")
    asked = parser.parse_args()
    runtime.prepare_xla()
    # a GPU would calculate with ten bits in float32
    jax.config.update("jax_default_matmul_precision", "highest")
    trained = policy_file.load(packaged.locate(asked.policy))
    given = {"temperature": asked.temperature, "ddim_steps": asked.ddim_steps}
    changed = {name: value for name, value in given.items() if value is not None}
    trained = trained._replace(policy=config.with_options(trained.policy, **changed))
    found = load.load(asked.demos)
    frames = np.linspace(0, len(found.dataset.episode) - 1, FRAMES).astype(int)
    batch = windows.gather(
        found.dataset, jnp.asarray(frames), trained.policy.obs_horizon, trained.policy.horizon
    )
    plan = functools.partial(planned, trained, batch)
    steps, temperature = trained.policy.options.ddim_steps, trained.policy.options.temperature
    used = parallel_ddim.evaluations_for(steps)
    wanted = plan("float32", diffusion.ddim_sample)
    ways = {"rounded to bfloat16": ("bfloat16", diffusion.ddim_sample)}
    for count in (used + more for more in AROUND):
        beside = functools.partial(parallel_ddim.ddim_sample, evaluations=count)
        ways[f"{count} evaluations"] = ("float32", beside)
    ways[f"{used} evaluations, rounded to bfloat16"] = ("bfloat16", parallel_ddim.ddim_sample)
    named = {}
    for name, way in ways.items():
        row = apart(plan(*way), wanted)
        print(f"{name:36}", *(f"{key} {value:.4f}" for key, value in row.items()), sep="  ")
        named[f"{steps} steps, temperature {temperature}, {name}"] = row
    _timing.report("ddim", {"policy": asked.policy, "frames": FRAMES, "results": named}, tiny=False)


def planned(
    trained: policy_file.Trained,
    batch: windows.Batch,
    dtype: str,
    ddim_sample: Callable,
) -> Command:
    """Commands `[FRAMES, H, A]` with this way to sample."""
    settings = dataclasses.replace(trained.policy, dtype=dtype)
    method, task = methods.METHODS[trained.method], registries.tasks.get(trained.scene.task)
    policy = policies.make(method, settings, task, trained.train, trained.scene.cameras)
    keys = jax.random.split(jax.random.key(1), FRAMES)
    given = (trained.params, trained.normalizer, keys, batch.observation, batch.trocar)
    # inputs of a policy for so many robots
    with mock.patch.object(diffusion, "ddim_sample", ddim_sample):
        return jax.jit(policy.sample)(*given)


def apart(said: Command, wanted: Command) -> dict[str, float]:
    """Distances of tips, mm, and differences of grippers, over all frames and times."""
    tip = 1e3 * np.linalg.norm(np.asarray(said.pose.p - wanted.pose.p), axis=-1)
    gripper = np.abs(np.asarray(said.gripper - wanted.gripper))
    return {
        "tip_mean_mm": float(tip.mean()),
        "tip_p99_mm": float(np.percentile(tip, 99)),
        "tip_max_mm": float(tip.max()),
        "gripper_max": float(gripper.max()),
    }


if __name__ == "__main__":
    main()
