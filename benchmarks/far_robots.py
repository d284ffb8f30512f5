"""No time: success of simulated robots that a server drives over a bad network, or dies.

    python benchmarks/far_robots.py OUT [--only "100 ms"] [--trials 2] [--policy compact] [--tiny]

OUT gets a result file for each network, as of `starjax evaluate`, with the clients' reports.
`_far_robots.py` has the clock.
"""

import argparse
import dataclasses
import shlex
import sys
import time
from pathlib import Path

import _far_robots
import numpy as np
from _far_robots import Network

from starjax import runtime
from starjax.core import config, config_json

IMAGE_SIZE = 128  # limit of the packaged policy
GROUP = 12  # trials that are simulated together
NETWORKS = {
    "no_delay": Network(ahead=0),
    "33_ms": Network(0.033),
    "100_ms": Network(0.1),
    "200_ms": Network(0.2),
    "400_ms": Network(0.4),
    "800_ms": Network(0.8),
    "jitter": Network(0.1, jitter_s=0.1),
    "drops": Network(0.1, drop=0.1),
    "killed": Network(0.1, kills_s=(2.0,)),
}
TINY = {"tiny": Network(0.1, drop=0.2, kills_s=(0.3,))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="folder of the results")
    parser.add_argument("--only", default="", help="networks whose name contains this")
    parser.add_argument("--policy", default="compact", help="name or file")
    parser.add_argument("--trials", type=int, default=2, help="at each of the twelve trocars")
    parser.add_argument("--seed", type=int, default=0, help="of the trials")
    parser.add_argument("--seconds", type=float, default=20.0, help="time limit, simulated")
    parser.add_argument("--tiny", action="store_true", help="a test's sizes")
    asked = parser.parse_args()
    runtime.prepare_xla()
    asked.out.mkdir(parents=True, exist_ok=True)
    networks = TINY if asked.tiny else NETWORKS
    server = _far_robots.Server(asked.policy, batch=4)
    try:
        simulation = _far_robots.programs(IMAGE_SIZE)
        for name, network in networks.items():
            if asked.only in name:
                measure(asked, server, simulation, name, network)
    finally:
        server.kill()


def measure(asked, server, simulation, name: str, network: Network) -> None:
    """Runs, prints and writes one network."""
    env, begun = simulation[0], time.perf_counter()
    ports = len(env.task.trocars.radius)
    group = [(c, n) for n in range(asked.trials) for c in range(ports)]
    if asked.tiny:
        group = group[:2]
    driven = _far_robots.Driven()
    for first in range(0, len(group), GROUP):
        some = group[first : first + GROUP]
        _far_robots.drive(simulation, server, network, some, asked.seed, asked.seconds, driven)
    spent = time.perf_counter() - begun
    told = summed(driven, network)
    figures = write(asked, env, driven, told, name, spent)
    print(
        f"{name:9} {figures['successes']}/{figures['trials']}  {told['missed']} of "
        f"{told['plans']} plans late, {told['held']} of {told['steps']} steps held, most "
        f"{told['move_mm']:.2f} mm and {told['turn_rad']:.3f} rad a step, commanded RCM error "
        f"{told['rcm_commanded_mm']:.1e} mm; {spent:.0f} s",
        flush=True,
    )


def summed(driven: _far_robots.Driven, network: Network) -> dict:
    """What all clients of a network report together."""
    names = ("steps", "plans", "missed", "stretched", "held", "limited", "refused", "lost")
    latencies = np.concatenate([report.latencies for report in driven.reports])
    off = np.concatenate([e.joined("rcm_error_commanded") for e in driven.episodes])
    return {
        "network": dataclasses.asdict(network),
        **{name: int(sum(getattr(r, name) for r in driven.reports)) for name in names},
        "reconnected": driven.reconnected,
        "outage_steps": driven.outages,
        "latency_steps_p50": float(np.median(latencies)),
        "latency_steps_max": int(latencies.max()),
        "move_mm": 1e3 * driven.move,
        "turn_rad": driven.turn,
        "rcm_commanded_mm": 1e3 * float(off.max()),
        "faults": sorted({r.fault for r in driven.reports if r.fault}),
    }


def write(asked, env, driven, told: dict, name: str, spent: float) -> dict:
    """Writes a result file; returns its strict successes of all trials."""
    from starjax import deploy
    from starjax.cli import policy_args
    from starjax.evaluation import result, statistics, trial_file, trials
    from starjax.policies import packaged, policy_file
    from starjax.runtime import files

    path = packaged.find("policy", asked.policy)
    trained = policy_file.load(path)
    driven.episodes.sort(key=lambda episode: episode.trial)
    table = trials.from_episodes(driven.episodes)
    figures = statistics.compose(
        table, env.task.is_seen, method=trained.method, observation="image", seed=asked.seed
    )
    settings = dataclasses.replace(
        policy_args.run_settings(trained),
        eval=config.EvalConfig(trials=asked.trials, time_limit_s=asked.seconds),
        out=str(asked.out),
    )
    about = {
        "control_hz": env.control_hz,
        "preset": settings.preset,
        "seed": asked.seed,
        "weights": files.sha256(path),
        "dataset_digest": None,
        "config": config_json.as_json(settings),
        "command": shlex.join(["python", "benchmarks/far_robots.py", *sys.argv[1:]]),
        "timings_s": {"evaluate": spent},
        "warnings": [],
        "served": {**told, "limits": list(deploy.Limits())},
    }
    file = asked.out / f"{name}.json"
    result.write(file, env.names, figures, about)
    trial_file.detach(file)
    return figures["strict"]["all"]


if __name__ == "__main__":
    main()
