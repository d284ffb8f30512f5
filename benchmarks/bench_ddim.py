"""How near DDIM whose steps are side by side comes to DDIM, after so many evaluations.

    starjax collect --preset compact --demos.per-trocar 2 --seed 77 --out runs/ddim
    python benchmarks/bench_ddim.py runs/ddim/demos-* [--policy compact] [--temperature 1]

A policy plans at frames of demonstrations that it did not learn from, each way with the same noise;
beside it, what calculating in bfloat16 in the place of float32 moves. No time is measured here:
bench_inference.py does that.
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
from starjax.data import load, windows
from starjax.experiments import methods
from starjax.models import diffusion, parallel_ddim
from starjax.policies import packaged
from starjax.policies import policy as policies
from starjax.sim import env as envs
from starjax.training import export
from starjax.types import Command

FRAMES = 128
EVALUATIONS = range(3, 9)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("demos", type=pathlib.Path)
    parser.add_argument("--policy", default="compact")
    parser.add_argument("--temperature", type=float, help="by default the policy's")
    asked = parser.parse_args()
    runtime.prepare_xla()
    trained = export.load(packaged.locate(asked.policy))
    if asked.temperature is not None:
        settings = dataclasses.replace(trained.policy, temperature=asked.temperature)
        trained = trained._replace(policy=settings)
    found = load.load(asked.demos)
    frames = np.linspace(0, len(found.dataset.episode) - 1, FRAMES).astype(int)
    batch = windows.gather(
        found.dataset, jnp.asarray(frames), trained.policy.obs_horizon, trained.policy.horizon
    )
    wanted = planned(trained, batch, "float32", diffusion.ddim_sample)
    rounded = planned(trained, batch, "bfloat16", diffusion.ddim_sample)
    rows = {"rounded to bfloat16": apart(rounded, wanted)}
    for count in EVALUATIONS:
        ddim = functools.partial(parallel_ddim.ddim_sample, evaluations=count)
        rows[f"{count} evaluations"] = apart(planned(trained, batch, "float32", ddim), wanted)
    for name, row in rows.items():
        print(f"{name:20}", *(f"{key} {value:.4f}" for key, value in row.items()), sep="  ")
    temperature = trained.policy.temperature
    facts = {"policy": asked.policy, "frames": FRAMES, "ddim_steps": trained.policy.ddim_steps}
    named = {f"temperature {temperature}, {name}": row for name, row in rows.items()}
    _timing.report("ddim", {**facts, "results": named}, tiny=False)


def planned(
    trained: export.Trained, batch: windows.Batch, dtype: str, ddim_sample: Callable
) -> Command:
    """Commands `[FRAMES, H]` with this way to sample."""
    settings = dataclasses.replace(trained.policy, dtype=dtype)
    port = envs.make(settings.observation, settings.image_size).p_world_ref
    policy = policies.make(methods.METHODS[trained.method], settings, port, trained.train)
    keys = jax.random.split(jax.random.key(1), FRAMES)
    given = (trained.params, trained.normalizer, keys, batch.observation, batch.trocar)
    # what a policy takes for so many robots
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
