"""A believable run directory made from a seed, for the report's tests."""

import json
import pathlib

import numpy as np

PORTS = [
    ((0.04, 0.02)[k % 2], np.deg2rad((80, 80, 100, 100)[k % 4]), np.pi / 4 * k) for k in range(8)
]
PORTS += [(r, np.deg2rad(t), np.deg2rad(p)) for r, t, p in ((0.05, 70, 67.5), (0.05, 110, 247.5))]
PORTS += [(r, np.deg2rad(t), np.deg2rad(p)) for r, t, p in ((0.05, 90, 157.5), (0.0, 90, 0.0))]
P_REF = np.array([0.0, 0.0, 0.15])


def run(path: pathlib.Path, method="stardiff", skill=(0.85, 0.7), trials=6, sweep=0, seed=0):
    """Writes result.json, metrics.jsonl, evaluation/recorded.npz (and sweep.json) under `path`."""
    rng = np.random.default_rng(seed)
    records = [
        _trial(rng, index, *PORTS[index], index < 8, trial, skill[index >= 8])
        for index in range(len(PORTS))
        for trial in range(trials)
    ]
    (path / "evaluation").mkdir(parents=True)
    (path / "result.json").write_text(json.dumps(_result(method, records)))
    (path / "metrics.jsonl").write_text("\n".join(json.dumps(line) for line in _curves(rng)))
    np.savez(path / "evaluation" / "recorded.npz", **_recorded(rng, records, 3))
    if sweep:
        ports = zip(0.05 * rng.random(sweep), np.deg2rad(rng.uniform(70, 110, sweep)))
        spread = [
            _trial(
                rng, k, r, t, 2 * np.pi * rng.random(), False, 0, skill[0] - 6 * max(0, r - 0.03)
            )
            for k, (r, t) in enumerate(ports)
        ]
        (path / "sweep.json").write_text(json.dumps({"trials": spread}))
    return path


def _trial(rng, trocar, radius, polar, azimuth, seen, trial, skill):
    success = bool(rng.random() < skill)
    return {
        "trocar": trocar,
        "radius": float(radius),
        "polar": float(polar),
        "azimuth": float(azimuth),
        "seen": seen,
        "trial": trial,
        "seed": 1000 * trocar + trial,
        "success": success,
        "loose": success or bool(rng.random() < 0.3),
        "safe": bool(rng.random() < 0.97),
        "invalid": False,
        "collided": not success and bool(rng.random() < 0.25),
        "steps": int(rng.integers(180, 420)) if success else 1800,
        "rcm_max_mm": float(rng.gamma(2, 0.1)),
    }


def _result(method, records):
    return {
        "method": method,
        "observation": "state",
        "rcm_error_mm": {
            "commanded": {"max": 3.1e-5},
            "executed": {"mean": 0.0041, "p99": 0.033, "max": 0.23},
        },
        "inference_ms": {"p50": 18.4, "p95": 21.0, "p99": 24.9},
        "trials": records,
        "config": {
            "method": method,
            "preset": "cpu",
            "seed": 0,
            "policy": {"observation": "state", "ddim_steps": 10},
            "demos": {"per_trocar": 30, "seen_trocars": 8},
        },
        "seed": 0,
        "versions": {"python": "3.11.9", "jax": "0.10.2", "mujoco": "4.0.0", "starjax": "0.1.0"},
        "hardware": {"cpu": "2 cores", "device": "cpu", "memory_gb": 7.6},
        "timings_s": {"collect": 142.0, "train": 421.5, "evaluate": 133.2},
        "command": f"python -m starjax.experiments.run --method {method}",
        "warnings": [
            "no GPU: the policy observes the state; --policy.observation image turns on images"
        ],
    }


def _curves(rng):
    for step in range(100, 6001, 100):
        noise = float(np.exp(0.08 * rng.standard_normal()))
        line = {"step": step, "kind": "train", "loss": (0.02 + 0.9 * np.exp(-step / 700)) * noise}
        yield line
        if step % 500 == 0:
            error = (0.8 + 9 * np.exp(-step / 900)) * noise
            errors = {"position_error_mm": error, "roll_error_deg": 3 * error}
            yield {"step": step, "kind": "holdout", **errors}


def _recorded(rng, records, per_trocar):
    kept = [r for r in records if r["trial"] < per_trocar]
    steps = max(r["steps"] for r in kept)
    paths, ports = np.zeros((len(kept), steps, 3), np.float32), []
    for row, r in enumerate(kept):
        source = np.array([rng.choice([-0.016, -0.038]), rng.choice([-0.024, 0, 0.024]), 0.009])
        target = np.array([rng.choice([0.016, 0.038]), rng.choice([-0.024, 0, 0.024]), 0.009])
        up = np.array([0, 0, 0.028])
        start = np.array([0, 0, 0.05]) + rng.uniform(-0.01, 0.01, 3)
        if not r["success"]:
            target = target + rng.normal(0, 0.008, 3) * [1, 1, 0.3]
        knots = np.array(
            [start, source + up, source, source, source + up, target + up, target, target]
        )
        grid = np.linspace(0, len(knots) - 1, r["steps"])
        path = np.stack([np.interp(grid, range(len(knots)), knots[:, i]) for i in range(3)], -1)
        width = r["steps"] // 12
        padded = np.pad(path, ((width, width), (0, 0)), mode="edge")
        kernel = np.hanning(2 * width + 1) / np.hanning(2 * width + 1).sum()
        smooth = [np.convolve(padded[:, i], kernel, mode="valid") for i in range(3)]
        paths[row, : r["steps"]] = np.stack(smooth, -1)
        radius, polar, azimuth = r["radius"], r["polar"], r["azimuth"]
        flat = radius * np.sin(polar)
        port = [flat * np.cos(azimuth), flat * np.sin(azimuth), radius * np.cos(polar)]
        ports.append(P_REF + port)
    return {
        "trocar": np.array([r["trocar"] for r in kept]),
        "trial": np.array([r["trial"] for r in kept]),
        "length": np.array([r["steps"] for r in kept]),
        "p_world_tip": paths,
        "p_world_trocar": np.array(ports),
    }
