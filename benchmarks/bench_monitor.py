"""Time of the runtime monitor: an update, against the inference whose plan it scores.

    python benchmarks/bench_monitor.py [--policy compact peg_transfer_bimanual]

Inference is that of the packaged policy for one robot, timed in the same run.
"""

import argparse
import time

import _timing
import numpy as np

from starjax import runtime
from starjax.core import methods
from starjax.evaluation import latency
from starjax.policies import features, in_env, packaged
from starjax.policies import policy as policies
from starjax.policies.monitor import record, scores, watch
from starjax.sim import registries

UPDATES = 150  # decisions of an episode, 40 s
STILL = 6  # decisions of the window of stillness


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policy", nargs="+", default=["compact", "peg_transfer_bimanual"])
    asked = parser.parse_args()
    runtime.prepare_xla()
    rows = {}
    print("policy  update, us  inference, ms  of it, %")
    for name in asked.policy:
        trained = in_env.read(packaged.find("--policy", name))
        update_ms = 1e3 * update_s(trained.policy.execute, len(trained.scene.arms))
        task = registries.tasks.get(trained.scene.task)
        sensors = features.select_sensors(task, trained.scene.cameras)
        row = methods.METHODS[trained.method]
        policy = policies.make(row, trained.policy, task, cameras=trained.scene.cameras)
        params = policy.prepare_for_inference(trained.params)
        found = latency.policy_ms(policy, trained.policy, params, trained.normalizer, sensors)
        fraction = update_ms / found["p50"]
        print(f"{name}  {1e3 * update_ms:.0f}  {found['p50']:.1f}  {100 * fraction:.2f}")
        rows[name] = {"update_ms": update_ms, "inference_ms": found["p50"], "fraction": fraction}
    _timing.report("monitor", {"results": rows}, tiny=False)


def update_s(execute: int, arms: int) -> float:
    """Returns the median time of an update in an episode whose windows are full."""
    rng = np.random.default_rng(0)
    plans = rng.normal(size=(UPDATES, 2 * execute, arms, 3))
    tips, openings = rng.normal(size=(UPDATES, arms, 3)), rng.uniform(-1, 1, (UPDATES, arms))
    whole = [np.zeros(len(scores.NAMES)), np.ones(len(scores.NAMES))]
    settings = scores.ScoreSettings(execute, 30.0, STILL)
    live = watch.Watch(record.Monitor(*whole, np.inf, 1.0, 0.05, 100, settings, ""))
    seconds = []
    for plan, tip, opening in zip(plans, tips, openings):
        start = time.perf_counter()
        live.update(plan, tip, gripper=opening)
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds[STILL:]))


if __name__ == "__main__":
    main()
