"""Times an inference over the socket and the same policy called in this process.

    python benchmarks/bench_serve.py [--policy compact] [--calls 200] [--tiny]

`starjax serve` runs in its own process on this machine. Calls to it and calls here alternate, so
other load affects both equally. Then the loop drives an ideal robot at 30 Hz and counts missed
deadlines.
"""

import argparse
import time

import _far_robots
import _timing
import jax
import numpy as np

from starjax import deploy, rcm, runtime
from starjax.deploy import batching, wire
from starjax.deploy.connection import Connection

LOOP_S = 10.0  # of the robot


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policy", default="compact", help="name or file")
    parser.add_argument("--calls", type=int, default=200, help="of each")
    parser.add_argument("--tiny", action="store_true", help="a test's sizes, nothing is written")
    asked = parser.parse_args()
    runtime.prepare_xla()
    calls, loop_s = (3, 0.5) if asked.tiny else (asked.calls, LOOP_S)
    policy = deploy.load(asked.policy)
    server = _far_robots.Server(asked.policy, batch=1)
    try:
        row = decisions(policy, server.address, calls)
        print(f"{'':10}  p50      p95      p99 ms")
        for name in ("here", "socket", "difference"):
            print(
                f"{name:10} {row[name]['p50']:8.2f} {row[name]['p95']:8.2f} {row[name]['p99']:8.2f}"
            )
        row["loop"] = driven = loop(policy, server.address, loop_s)
        print(
            f"30 Hz for {loop_s:g} s: {driven['missed']} of {driven['plans']} plans late, "
            f"{driven['overran']} of {driven['steps']} periods too long"
        )
    finally:
        server.kill()
    _timing.report("serve", {"results": {asked.policy: row}}, asked.tiny)


def decisions(policy: deploy.Deployed, address: str, calls: int) -> dict:
    """Returns percentiles, ms, of calls here, over the socket, and of the difference."""
    request = batching.example(policy.input_spec)
    seen, trocar = request.observation, request.trocar
    connection = Connection(address, "", 60.0, 60.0)

    def here(number: int) -> None:
        jax.device_get(policy(jax.random.key(number), seen, trocar))

    def socket(number: int) -> None:
        key = np.asarray(jax.random.key_data(jax.random.key(number)))
        connection.send(wire.encode_request(policy.input_spec, seen, trocar, key))
        reply = connection.wait(60.0)
        wire.decode_reply(policy.input_spec, policy.settings.horizon, reply.value)

    times = {"here": [], "socket": []}
    for number in range(-3, calls):
        for name, call in (("here", here), ("socket", socket)):
            spent = 1e3 * _timing.time_once(lambda call=call: call(number))  # noqa: B023
            if number >= 0:
                times[name].append(spent)
    connection.close()
    row = {name: percentiles(found) for name, found in times.items()}
    row["difference"] = {name: row["socket"][name] - row["here"][name] for name in row["here"]}
    return {"calls": calls, **row}


def percentiles(times: list[float]) -> dict[str, float]:
    return {f"p{q}": float(np.percentile(times, q)) for q in (50, 95, 99)}


class Robot:
    """An ideal robot: it reaches every command."""

    def __init__(self, moment: deploy.Observation) -> None:
        self.moment = moment

    def measure(self) -> deploy.Observation:
        return self.moment

    def send(self, command: deploy.Command) -> None:
        self.moment = self.moment.replace(pose=command.pose, gripper=command.gripper)


def loop(policy: deploy.Deployed, address: str, seconds: float) -> dict:
    """Drives a robot in real time and returns the client's counts."""
    request = batching.example(policy.input_spec)
    port = rcm.Trocar(*(float(np.ravel(field)[0]) for field in request.trocar))
    robot = Robot(jax.tree.map(lambda x: x[0], request.observation))
    # This robot looks at noise: a monitor would stop it.
    with deploy.Client(address, port, key=jax.random.key(0), is_watched=False) as client:
        begun = time.perf_counter()
        report = client.run(robot, seconds)
        spent = time.perf_counter() - begun
    return {
        "seconds": spent,
        **{name: getattr(report, name) for name in ("steps", "plans", "missed", "held", "overran")},
        "latency_steps_max": max(report.latencies),
    }


if __name__ == "__main__":
    main()
