"""Learners side by side: milliseconds of a decision, and on a GPU of a training step.

    python benchmarks/bench_learners.py [--only flow] [--tiny]

All with the encoder, the sizes and the training of preset `compact`, from pictures, untrained: the
is in the weights does not change the time. `diffusion` is the peer in the same run.
"""

import argparse
import dataclasses

import _peer
import _setup
import _timing

from starjax import runtime
from starjax.cli import presets
from starjax.core import config
from starjax.core.learners import LEARNERS
from starjax.evaluation import latency
from starjax.policies import features

SEEN = features.select_sensors(_setup.TASK)
BATCHES = {"gpu": (1, 360), "cpu": (1,), "tiny": (1,)}
PEER = "diffusion"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="a learner; the peer runs too")
    parser.add_argument("--seconds", type=float, default=2.0, help="of timed calls a row")
    parser.add_argument("--tiny", action="store_true", help="a test's sizes, nothing is written")
    asked = parser.parse_args()
    runtime.prepare_xla()
    kind = "tiny" if asked.tiny else _peer.platform()
    names = [name for name in LEARNERS.names() if asked.only in ("", name) or name == PEER]
    rows: dict[str, dict] = {}
    for name in names:
        case = _case(name, kind)
        row = {
            f"batch {batch}": _decision(case, batch, asked.seconds) for batch in BATCHES[kind]
        } | ({"training": _training(case)} if kind == "gpu" else {})
        rows[name] = row
        peer = rows[PEER]
        said = (
            f"{key} {x['p50']:.2f} ms ({peer[key]['p50'] / x['p50']:.1f} x)"
            for key, x in row.items()
        )
        print(f"{name:10} {'; '.join(said)}", flush=True)
        _timing.report("learners", {"results": {name: row}}, asked.tiny)


def _case(learner: str, kind: str) -> _setup.Case:
    if kind == "tiny":
        case = _setup.miniature()
        return case._replace(policy=config.with_learner(case.policy, learner))
    preset = presets.PRESETS["compact"]
    policy = config.with_learner(preset.policy, learner)
    if kind == "cpu":  # as a packaged policy is run
        policy = dataclasses.replace(policy, dtype="float32")
    return _setup.Case(policy, preset.train)


def _decision(case: _setup.Case, batch: int, seconds: float) -> dict:
    """Percentiles of one call, ms."""
    policy, params, stats = _setup.untrained(case)
    given = (policy, case.policy, params, stats, SEEN)
    return latency.policy_ms(*given, batch=batch, calls=200, seconds=seconds)


def _training(case: _setup.Case) -> dict:
    """Milliseconds of a step, the dataset resident on the device."""
    job = _setup.job(case)
    inputs = (job.carry, job.dataset, job.per_call)
    timing, _ = _timing.time_carried(job.steps, *inputs, calls=job.calls, **job.options)
    return {"p50": 1e3 * timing.median_s / (job.calls * job.per_call)}


if __name__ == "__main__":
    main()
