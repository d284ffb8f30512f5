"""A believable run directory made from a seed, for the report's tests."""

import json
import pathlib

import fakes
import numpy as np
import stubs

from starjax import rcm
from starjax.core import config, config_json
from starjax.evaluation import result, statistics, sweep
from starjax.evaluation import trials as table
from starjax.sim import registries
from starjax.sim.rollouts import trocars

P_REF = np.array([[0.0, 0.0, 0.15]], np.float32)
WEIGHTS = "0" * 64


def run(path: pathlib.Path, method="stardiff", skill=(0.85, 0.7), trials=6, sweep_of=0, seed=0):
    """Writes result.json, metrics.jsonl, evaluation/recorded.npz (and sweep.json) under `path`."""
    rng = np.random.default_rng(seed)
    index = np.repeat(np.arange(12), trials)
    twelve = trocars.select(stubs.trocars(*range(12)), index)
    rows = outcomes(rng, twelve, index, np.where(rcm.IS_SEEN[index], *skill))
    (path / "evaluation").mkdir(parents=True)
    write(path / "result.json", method, rows, seed)
    (path / "metrics.jsonl").write_text("\n".join(json.dumps(line) for line in curves(rng)))
    np.savez(path / "evaluation" / "recorded.npz", **recorded(rng, rows, 3))
    if sweep_of:
        places = sweep.sample(seed, sweep_of, registries.tasks.get("peg_transfer"))
        chance = skill[0] - 6 * np.maximum(0, places.radius[:, 0] - 0.03)
        spread = outcomes(rng, places, np.arange(sweep_of), chance)
        figures = sweep.compose(
            spread, trocars.select(stubs.trocars(*range(12)), rcm.IS_SEEN), P_REF, seed=0
        )
        about = {"method": method, "observation": "state", "weights": WEIGHTS}
        about |= {"control_hz": 30.0, "time_limit_s": 60.0, "seed": 0}
        result.write(path / "sweep.json", fakes.SCENE, figures, about)
    return path


def outcomes(rng, places, index, chance):
    """A table of trials that succeed with the given chances, at trocars `[M, A]`."""
    success = rng.random(len(index)) < chance
    steps = np.where(success, rng.integers(180, 420, len(index)), 1800).astype(np.int32)
    largest = rng.gamma(2, 1e-4, len(index)).astype(np.float32)
    return table.Table(
        trocar=index.astype(np.int32),
        radius=places.radius,
        polar=places.polar,
        azimuth=places.azimuth,
        trial=np.concatenate([np.arange(n) for n in np.bincount(index)]),
        success=success,
        loose=success | (rng.random(len(index)) < 0.2),
        safe=success & (rng.random(len(index)) < 0.97),
        invalid=np.zeros(len(index), bool),
        collided=~success & (rng.random(len(index)) < 0.25),
        lost=np.zeros(len(index), bool),
        steps=steps,
        stage=np.where(success, 3, 1),
        labels={
            "source": rng.integers(0, 6, len(index)),
            "target": rng.integers(6, 12, len(index)),
        },
        rcm_commanded_max=np.full(len(index), 3.1e-8, np.float32),
        rcm_mean=largest / 8,
        rcm_max=largest,
        rcm_within_max=1.5 * largest,
        rcm_error_mm=np.repeat(125 * largest, steps).astype(np.float16),
        rcm_within_mm=np.repeat(190 * largest, steps).astype(np.float16),
    )


def figures(method, rows):
    """What an evaluation counts."""
    return statistics.compose(rows, rcm.IS_SEEN, method=method, observation="state", seed=0)


def about(method, seed=0):
    """Provenance of a run."""
    settings = config.RunConfig(
        method=method, preset="cpu", seed=seed, policy=config.PolicyConfig(observation="state")
    )
    return {
        "control_hz": 30.0,
        "seed": seed,
        "weights": WEIGHTS,
        "preset": "cpu",
        "inference_ms": {"p50": 18.4, "p95": 21.0, "p99": 24.9},
        "config": config_json.as_json(settings),
        "timings_s": {"collect": 142.0, "collect: compile": 31.0, "train": 421.5, "evaluate": 133},
        "command": f"python -m starjax.experiments.run --method {method}",
        "warnings": ["The policy observes the simulator's state, not pixels as in the paper."],
    }


def write(file, method, rows, seed=0):
    """result.json of an evaluation."""
    return result.write(file, fakes.SCENE, figures(method, rows), about(method, seed))


def curves(rng):
    """Lines of metrics.jsonl."""
    for step in range(100, 6001, 100):
        noise = float(np.exp(0.08 * rng.standard_normal()))
        yield {"step": step, "kind": "train", "loss": (0.02 + 0.9 * np.exp(-step / 700)) * noise}
        if step % 500 == 0:
            error = (0.8 + 9 * np.exp(-step / 900)) * noise
            errors = {"position_error_mm": error, "roll_error_deg": 3 * error}
            yield {"step": step, "kind": "holdout", **errors}


def recorded(rng, rows, per_trocar):
    """Trajectories of each trocar's first trials, as `evaluation.evaluate` records them."""
    kept = np.flatnonzero(rows.trial < per_trocar)
    length = rows.steps[kept]
    tip = np.full((len(kept), length.max(), 3), np.nan, np.float32)
    for out, row, steps in zip(tip, kept, length):
        out[:steps] = path(rng, steps, rows.success[row])
    places = rcm.Trocar(rows.radius[kept], rows.polar[kept], rows.azimuth[kept])
    return {
        "trocar": rows.trocar[kept],
        "trial": rows.trial[kept],
        "length": length,
        "p_world_tip": tip[:, :, None],
        "rcm_error": np.where(np.isnan(tip[..., :1]), np.nan, rows.rcm_max[kept, None, None]),
        "p_world_trocar": np.asarray(rcm.trocar_position(places, P_REF)),
        **{f"labels.{name}": values[kept] for name, values in rows.labels.items()},
    }


def path(rng, steps, success):
    """`[steps, 3]` m: to a source peg, up, over to a target peg, down."""
    source = np.array([rng.choice([-0.016, -0.038]), rng.choice([-0.024, 0, 0.024]), 0.009])
    target = np.array([rng.choice([0.016, 0.038]), rng.choice([-0.024, 0, 0.024]), 0.009])
    target += 0 if success else rng.normal(0, 0.008, 3) * [1, 1, 0.3]
    up, start = np.array([0, 0, 0.028]), np.array([0, 0, 0.05]) + rng.uniform(-0.01, 0.01, 3)
    knots = np.array([start, source + up, source, source, source + up, target + up, target, target])
    grid = np.linspace(0, len(knots) - 1, steps)
    line = np.stack([np.interp(grid, range(len(knots)), column) for column in knots.T], -1)
    width = steps // 12
    kernel = np.hanning(2 * width + 1) / np.hanning(2 * width + 1).sum()
    padded = np.pad(line, ((width, width), (0, 0)), mode="edge")
    return np.stack([np.convolve(column, kernel, mode="valid") for column in padded.T], -1)
