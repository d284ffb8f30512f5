"""A policy's node and a robot in another process, over DDS on this computer, by a robot's clock."""

import contextlib
import json
import pathlib
import socket
import subprocess
import sys

import numpy as np

from starjax import deploy, rcm
from starjax.addons.robots import arm, bus, kinematics, node, psm, robot_file, topic_table
from starjax.deploy.connection import Reply


def free_domain():
    """Domain that no other test run of this computer has, for the life of this process."""
    for domain in range(64, 101):
        held = socket.socket()
        try:
            held.bind(("127.0.0.1", 27_000 + domain))
        except OSError:
            continue
        return domain, held
    raise OSError("all domains are in use")


DOMAIN, _HELD = free_domain()
BASE = np.array([0.014, 0.014, 0.153])
HORIZON, EXECUTE = 16, 8
FILE = f"""
[arm]
namespace = "/PSM1"
position = {BASE.tolist()}
command = "COMMAND"
[trocar]
topic = "/trocar"
[camera.camera]
topic = "/camera/image_raw"
[limits]
speed = 0.05
turn_rate = 1.0
stale_s = 0.5
following_m = 0.006
[network]
domain = {DOMAIN}
interface = "lo"
use_sim_time = true
"""
HOME = kinematics.of_psm(psm.LARGE_NEEDLE_DRIVER).home


ASKS = {
    "moments": 1,
    "arms": [],
    "p_world_ref": [0.0, 0.0, 0.15],
    "keeps_to_manifold": True,
    "image_size": 32,
    "cameras": ["camera"],
    "state_size": 0,
}
GREETING = {"control_hz": 30.0, "horizon": HORIZON, "execute": EXECUTE, "asks": ASKS}


class Circle:
    """A policy in the place of a connection: the tip goes round, the tool straight through."""

    metadata = GREETING
    is_up, connections = True, 1

    def __init__(self, where=BASE):
        self.reply, self.phase, self.middle, self.where = None, 0, None, np.float32(where)

    def send(self, value):
        tip, R = value["p"][-1], value["R"][-1]
        if self.middle is None or np.linalg.norm(tip - self.middle) > 0.02:
            self.middle, self.phase = tip - [0.01, 0.0, 0.0], 0
        angle = 2 * np.pi / 120 * (self.phase + np.arange(1, HORIZON + 1))
        ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
        tips = (self.middle + 0.01 * ring).astype(np.float32)
        roll = float(rcm.roll_of(R))
        turned = rcm.rotation_from_axis_roll(tips - self.where, np.full(HORIZON, roll))
        R = np.asarray(turned, np.float32)
        self.reply = {"R": R, "p": tips, "gripper": np.full(HORIZON, 0.2, np.float32)}
        self.phase += EXECUTE

    def poll(self):
        reply, self.reply = self.reply, None
        return None if reply is None else Reply(reply)

    def close(self):
        pass


class Process:
    """A robot in another process."""

    def __init__(self, *args):
        path = pathlib.Path(__file__).parent / "robots" / "robot_process.py"
        argv = [sys.executable, str(path), str(DOMAIN), *map(str, args)]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        self.process = subprocess.Popen(argv, **pipes)
        assert self.process.stdout.readline() == "ready\n"

    def say(self, line):
        self.process.stdin.write(f"{line}\n")
        self.process.stdin.flush()

    def end(self):
        self.say("end")
        return json.loads(self.process.communicate(timeout=30)[0])

    def kill(self):
        self.process.kill()
        self.process.wait()


@contextlib.contextmanager
def robot(*args):
    process = Process(*args)
    try:
        yield process
    finally:
        process.kill()


def file_of(tmp_path, command="servo_jp", **changed):
    text = FILE.replace("COMMAND", command)
    for old, new in changed.items():
        text = text.replace(f"[{old}]", f"[{old}]\n{new}")
    path = tmp_path / "robot.toml"
    path.write_text(text)
    return robot_file.read(path)


@contextlib.contextmanager
def made(own_bus, file, is_dry=False):
    """The arm's side that is ready, and its client."""
    limits = deploy.Limits(file.limits.speed, file.limits.turn_rate)
    options = {"connect": lambda *_: Circle(file.p_world_trocar), "clock": own_bus.now}
    options |= {"limits": limits, "tolerances": node.tolerances(file, is_dry)}
    with deploy.Client("", file.p_world_trocar, **options) as client:
        one = arm.CrtkArm(own_bus, file, 32)
        yield one, client, topic_table.look(one, 0.3, 60.0, lambda: False)


def later(process, line, after=15):
    """A stop condition that spoils the robot after some control steps and never stops the run."""
    steps = iter(range(10**6))

    def should_stop():
        if next(steps) == after:
            process.say(line)
        return False

    return should_stop


def drive(path):
    """Drives a robot in a process of its own until it is killed."""
    file = robot_file.read(path)
    own = bus.Bus(file.network)
    with made(own, file) as (one, client, _):
        node.run(one, client, 600.0)
