"""Times an inference over the socket and in this process, and a robot's topics.

    python benchmarks/bench_serve.py [--only socket] [--only topics] [--calls 200] [--tiny]

`starjax serve` runs in its own process on this machine. Calls to it and calls here alternate, so
other load affects both equally. Then the loop drives an ideal robot at 30 Hz and counts missed
deadlines. `starjax sim-robot` in its own process takes commands at 120 Hz over ROS 2 topics: a
round trip ends with the setpoint that answers, at most a period of that robot later.
"""

import argparse
import os
import subprocess
import sys
import time

import _far_robots
import _timing
import jax
import numpy as np

from starjax import deploy, rcm, runtime
from starjax.deploy import batching, wire
from starjax.deploy.connection import Connection

LOOP_S = 10.0  # time of the robot
DOMAIN = 62  # of DDS; tests have those from 64 on
START_S = 300.0  # for the robot's process
LOST_S = 0.5  # after which a command counts as lost: another has replaced it


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policy", default="compact", help="name or file")
    parser.add_argument("--calls", type=int, default=200, help="of each")
    parser.add_argument("--only", action="append", choices=("socket", "topics"))
    parser.add_argument("--tiny", action="store_true", help="a test's sizes, nothing is written")
    asked = parser.parse_args()
    runtime.prepare_xla()
    calls, loop_s = (3, 0.5) if asked.tiny else (asked.calls, LOOP_S)
    results, only = {}, asked.only or ("socket", "topics")
    if "topics" in only:
        results["topics"] = row = topics(10 * calls)
        for name in ("round_trip", "period"):
            print(f"topics, {name:10} {row[name]['p50']:6.2f} {row[name]['p99']:8.2f} ms p50, p99")
    if "socket" in only:
        results[asked.policy] = socket(asked.policy, calls, loop_s)
    _timing.report("serve", {"results": results}, asked.tiny)


def topics(calls: int) -> dict:
    """Returns percentiles, ms, of round trips of commands, and of the periods of measurements.

    `load` is the machine's, of one minute: this program and the robot's add up to 2.
    """
    from starjax.addons.robots import bus, messages, psm, robot_file

    load = os.getloadavg()[0]
    argv = [sys.executable, "-m", "starjax", "sim-robot", "--domain", str(DOMAIN)]
    simulated = subprocess.Popen(argv, stdout=subprocess.DEVNULL)
    own, times, periods = bus.Bus(robot_file.Network(DOMAIN, "lo")), [], []
    names = "/PSM1/setpoint_js", "/PSM1/measured_js"
    for name in names:
        own.read(name, messages.JointState)
    try:
        end = time.perf_counter() + START_S
        while not set(names) <= set(own.newest):
            if time.perf_counter() > end:
                raise SystemExit("starjax sim-robot: no topics")
            own.poll()
            time.sleep(0.01)
        writer = own.writer("/PSM1/servo_jp", messages.JointState, "servo")
        q = np.array(own.newest["/PSM1/measured_js"].position)
        time.sleep(1.0)  # readers and writers find each other
        came = time.perf_counter()
        for _ in range(calls):
            q[0] += 1e-5
            header = messages.Header(messages.stamp(), "PSM1_base")
            sent = time.perf_counter()
            writer.write(messages.JointState(header, list(psm.JOINTS), q.tolist()))
            is_back = False
            while time.perf_counter() - sent < LOST_S and not is_back:
                fresh, now = own.poll(), time.perf_counter()
                if "/PSM1/measured_js" in fresh:
                    periods.append(1e3 * (now - came))
                    came = now
                is_back = own.newest["/PSM1/setpoint_js"].position[0] == q[0]
                time.sleep(1e-4)
            if is_back:
                times.append(1e3 * (time.perf_counter() - sent))
    finally:
        simulated.kill()
    row = {"round_trip": percentiles(times), "period": percentiles(periods[1:])}
    return {"calls": calls, "lost": calls - len(times), "load": load, **row}


def socket(name: str, calls: int, loop_s: float) -> dict:
    """Returns times of inferences, and counts of a loop, over the socket."""
    policy = deploy.load(name)
    server = _far_robots.Server(name, batch=1)
    try:
        row = decisions(policy, server.address, calls)
        print(f"{'':10}  p50      p95      p99 ms")
        for part in ("here", "socket", "difference"):
            p50, p95, p99 = row[part].values()
            print(f"{part:10} {p50:8.2f} {p95:8.2f} {p99:8.2f}")
        row["loop"] = driven = loop(policy, server.address, loop_s)
        print(
            f"30 Hz for {loop_s:g} s: {driven['missed']} of {driven['plans']} plans late, "
            f"{driven['overran']} of {driven['steps']} periods too long"
        )
    finally:
        server.kill()
    return row


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
