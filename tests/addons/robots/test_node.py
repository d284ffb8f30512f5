"""A policy's node and a robot in another process, over DDS on this computer."""

import contextlib
import dataclasses
import io
import json
import os
import pathlib
import resource
import subprocess
import sys
import time

import mistakes
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

pytest.importorskip("cyclonedds")

from starjax import deploy, rcm
from starjax.addons.robots import (
    arm,
    between,
    bus,
    crtk,
    kinematics,
    markers,
    messages,
    node,
    psm,
    robot_file,
    topic_table,
)
from starjax.deploy.connection import Reply

DOMAIN = 60 + int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:])
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
        path = pathlib.Path(__file__).with_name("robot_process.py")
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


@pytest.fixture(scope="module")
def own_bus():
    return bus.Bus(robot_file.Network(DOMAIN, "lo", use_sim_time=True))


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
        yield one, client, topic_table.look(one, 0.3, 20.0, lambda: False)


def later(process, line, after=15):
    """A stop condition that spoils the robot after some control steps and never stops the run."""
    steps = iter(range(10**6))

    def should_stop():
        if next(steps) == after:
            process.say(line)
        return False

    return should_stop


@pytest.mark.parametrize("command", ["servo_jp", "servo_cp"])
def test_two_processes_move_a_tip_round_over_topics(own_bus, tmp_path, command):
    with robot() as process, made(own_bus, file_of(tmp_path, command)) as (one, client, rows):
        assert topic_table.problems(rows) == [] and node.doubts(one, client) == []
        watcher, kinds = bus.Bus(one.file.network), {"markers": markers.MarkerArray}
        kinds |= {"rcm_error": messages.Float64, "plan": messages.Path}
        for name, kind in kinds.items():
            watcher.read(f"{node.AT}/{name}", kind)
        watcher.read(f"{node.AT}/state", messages.StringStamped, "latched")
        report = node.run(one, client, 2.0)
        assert report.fault == "" and report.silent == 0 and report.plans >= 5
        watcher.poll()
        shown = {topic.removeprefix("/starjax/"): x for topic, x in watcher.newest.items()}
        assert 0.0 <= shown["rcm_error"].data < 1e-4 and shown["state"].string == "running"
        trocar, shaft, plan, text = shown["markers"].markers
        assert trocar.pose.position.z == pytest.approx(BASE[2]) and "running" in text.text
        assert len(shaft.points) == 2 and len(plan.points) == len(shown["plan"].poses) > 2
        assert one.sent == 4 * report.steps  # 120 Hz
        told = process.end()
    assert told["commands"] > 0.5 * one.sent  # newer ones replace those that are late
    assert told["moved"] < 0.005
    tip = psm.tip_of(np.array(told["q"]), psm.LARGE_NEEDLE_DRIVER).p
    start = psm.tip_of(HOME, psm.LARGE_NEEDLE_DRIVER).p
    assert np.linalg.norm(tip - start) > 0.015  # half round a circle of 10 mm


@pytest.mark.parametrize(
    ("line", "name"),
    [
        ("freeze", "stale pose"),
        ("state PAUSED", "state"),
        ("trocar 0.004 0 0", "moved trocar"),
        ("rival", "commander"),
        ("warn joint 2 limit", "warning: joint 2 limit"),
    ],
)
def test_a_doubt_silences_the_node(own_bus, tmp_path, line, name):
    with robot() as process, made(own_bus, file_of(tmp_path)) as (one, client, _):
        report = node.run(one, client, 8.0, should_stop=later(process, line))
        assert report.fault.startswith(name), report
        sent = one.sent
        assert 15 * 4 <= sent < 8 * 120 * 0.6
        told = process.end()
    assert told["commands"] <= sent and told["moved"] < 0.005


def test_a_robot_that_is_killed_and_back_elsewhere_is_not_pulled(own_bus, tmp_path):
    with robot() as first, made(own_bus, file_of(tmp_path)) as (one, client, _):
        stop = iter([False] * 20 + [True])
        node.run(one, client, 5.0, should_stop=lambda: next(stop))
        first.kill()
        with robot(0.25) as second:
            report = node.run(one, client, 5.0)  # until the first doubt: no person confirms
            assert report.fault and client.report.silent
            deadline = time.monotonic() + 20.0
            while node.doubts(one, client) and time.monotonic() < deadline:
                one.poll()
                time.sleep(0.01)
            client.restart(one.measure())
            client.report.fault = ""
            again = node.run(one, client, 2.0)
            assert again.fault == "", again
            told = second.end()
    assert told["commands"] > 50 and told["moved"] < 0.01


def test_a_dry_run_sends_nothing(own_bus, tmp_path):
    with robot() as process, made(own_bus, file_of(tmp_path), is_dry=True) as (one, client, _):
        report = node.run(one, client, 1.0, is_dry=True)
        assert report.plans >= 2 and one.sent == 0 and process.end()["commands"] == 0


def test_a_wrong_instrument_is_found_before_anything_is_sent(own_bus, tmp_path):
    file = file_of(tmp_path, arm='instrument = "prograsp"')
    with robot() as process, made(own_bus, file) as (one, client, _):
        assert "frames" in [doubt.name for doubt in node.doubts(one, client)]
        assert node.run(one, client, 1.0).fault.startswith("frames")
        assert one.sent == 0 and process.end()["commands"] == 0


def test_a_wrong_base_is_found_by_the_setpoint(own_bus, tmp_path):
    """Measurements agree in any base; the robot's own setpoint does not."""
    with robot() as process, made(own_bus, file_of(tmp_path)) as (one, client, _):
        command = client.step(one.measure())
        assert one.check_first(command) == []
        aside = command._replace(pose=command.pose._replace(p=command.pose.p + 0.01))
        (doubt,) = one.check_first(aside)
        assert doubt.name == "first command" and one.sent == 0
        process.end()


def test_a_second_node_is_refused_and_disturbs_nobody(own_bus, tmp_path):
    """The first one's writers are another participant's."""
    file = file_of(tmp_path)
    with robot() as process, made(own_bus, file) as (one, client, _):
        second = bus.Bus(file.network)
        with made(second, file) as (other, rival, _):
            seen = []

            def look():
                other.poll()
                seen.extend(doubt.name for doubt in node.doubts(other, rival))
                return False

            report = node.run(one, client, 2.0, should_stop=look)
            assert report.fault == "" and "commander" in seen and other.sent == 0
        process.end()


def test_a_command_out_of_reach_is_not_sent(own_bus, tmp_path):
    with robot() as process, made(own_bus, file_of(tmp_path)) as (one, client, _):
        command = client.step(one.measure())
        deep = command._replace(pose=command.pose._replace(p=command.pose.p - [0.0, 0.0, 0.2]))
        with mistakes.of("outer_insertion"):
            one.send(deep)
        assert one.sent == 0
        process.end()


@pytest.mark.release
def test_ten_minutes_of_a_redundant_arm_do_not_drift(own_bus, tmp_path):
    """Joints of a seven-joint arm after 150 rounds are those after the first few."""
    kin = kinematics.of("panda", "grasper", "peg_transfer")
    base, tip = kin.pose_world_base, kin.tip_of(kin.home)
    above = deploy.Pose(np.eye(3), tip.p - 0.1 * tip.R[:, 2])  # as in the robot's process
    where = crtk.compose(base, above).p
    file = file_of(
        tmp_path,
        arm='kind = "panda"\ninstrument = "grasper"\n'
        f"quaternion_xyzw = {Rotation.from_matrix(base.R).as_quat().tolist()}",
        trocar=f"position = {where.tolist()}",
    )
    placed = dataclasses.replace(file.arm, position=tuple(base.p.tolist()))
    file = dataclasses.replace(file, arm=placed)
    joints, errors, sizes = [], [], []

    with robot(0.0, "panda", "grasper") as process, made(own_bus, file) as (one, client, rows):
        assert topic_table.problems(rows) == [] and node.doubts(one, client) == []

        def look():
            if client.report.steps % 120 == 60:  # once a round, at the same angle
                joints.append(one.snapshot(0.0).joints)
                errors.append(float(rcm.rcm_error(one.measure().shaft, client.p_world_trocar)))
                sizes.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
            return False

        report = node.run(one, client, 600.0, should_stop=look)
        process.end()
    assert report.fault == "" and report.silent == 0 and report.steps == 18_000
    assert max(errors) < 2e-4  # m
    drift = np.abs(np.array(joints[5:]) - joints[5]).max()
    assert len(joints) > 140 and drift < 0.02, drift  # rad
    assert sizes[-1] - sizes[10] < 20_000  # KiB


def test_a_compressed_picture_is_read(own_bus, tmp_path):
    file = file_of(tmp_path)
    topic = "/camera/image_raw/compressed"
    file = dataclasses.replace(file, cameras={"camera": robot_file.CameraTable(topic)})
    one, picture = arm.CrtkArm(own_bus, file, 32), np.zeros((40, 60, 3), np.uint8)
    picture[:, 30:, 0] = 200
    data = io.BytesIO()
    Image.fromarray(picture).save(data, "PNG")
    own_bus.newest[topic] = messages.CompressedImage(messages.Header(), "png", data.getvalue())
    seen = one._image("camera camera")
    assert seen.shape == (32, 32, 3) and seen[:, :15].max() == 0 and seen[:, 17:, 0].min() == 200
    own_bus.newest[topic] = messages.CompressedImage(messages.Header(), "png", b"no file")
    with mistakes.of("camera camera"):
        one._image("camera camera")


def test_a_topic_without_a_writer_is_named(own_bus, tmp_path):
    file = file_of(tmp_path)
    absent = dataclasses.replace(file, arm=dataclasses.replace(file.arm, namespace="/PSM9"))
    one = arm.CrtkArm(own_bus, absent, 32)
    rows = topic_table.look(one, 0.1, 0.1, lambda: False)
    found = topic_table.problems(rows)
    assert any(line.startswith("/PSM9/measured_js") for line in found)
    assert "/PSM9/measured_js" in topic_table.text(rows)
    with mistakes.of("robot"):
        one.measure()


def test_commands_between_two_lie_on_the_manifold():
    where = np.float32([0.0, 0.0, 0.15])
    axes = np.float32([[0.1, 0.0, -1.0], [0.2, 0.1, -1.0]])
    R, p = rcm.pose_on_manifold(axes, np.float32([0.2, 0.5]), np.float32([0.1, 0.12]), where)
    a, b = (deploy.Command(deploy.Pose(R[i], p[i]), np.float32(i)) for i in range(2))
    way = between.of(None, 4)(a, b, where)
    assert [float(one.gripper) for one in way] == [0.25, 0.5, 0.75, 1.0]
    tips = np.stack([a.pose.p, *(one.pose.p for one in way)])
    assert max(float(rcm.rcm_error(one.pose, where)) for one in way) < 1e-6
    steps = np.linalg.norm(np.diff(tips, axis=0), axis=-1)
    np.testing.assert_allclose(steps, steps.mean(), rtol=0.1)
    np.testing.assert_allclose(tips[-1], b.pose.p, atol=1e-6)
    still = between.of(None, 4)(a, a, where)
    np.testing.assert_allclose(still[0].pose.p, a.pose.p, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "argument"),
    [
        ('[arm]\nnamespace = "/PSM1"\ncommand = "move_cp"', "arm.command"),
        ('[arm]\nnamespace = "/PSM1"\nframe = ""', "arm.frame"),
        ('[arm]\nnamespace = "/PSM1"\nrate = 5', "arm.rate"),
        ('[arm]\nnamespace = "/PSM1"\nkind = "kuka"', "arm.kind"),
        ('[arm]\nnamespace = "/A"\nkind = "fr5"\ncommand = "servo_cp"', "arm.command"),
        ('[arm]\nnamespace = "/A"\nkind = "fr5"\ninstrument = "scissors"', "arm.instrument"),
        ('[arm]\nnamespace = "/A"\nkind = "fr5"\ninstrument = "grasper"', "trocar.position"),
        ('[arm]\nnamespace = "/PSM1"\n[topics]\npose = "measured"', "topics.pose"),
        ('[arm]\nnamespace = "/PSM1"\n[topics]\nposes = "/measured"', "topics.poses"),
        ('[arm]\nnamespace = "/PSM1"\n[network]\nuse_sim_time = 1', "network.use_sim_time"),
        ('[arm]\nnamespace = "/PSM1"\nposition = [14.0, 14.0, 153.0]', "arm.position"),
        ('[arm]\nnamespace = "/PSM1"\nquaternion_xyzw = [0, 0, 0, 2]', "arm.quaternion_xyzw"),
        ('[arm]\nnamespace = "/PSM1"\nspeed = 1', "arm.speed"),
        ("[arm]", "arm.namespace"),
        ('[arm]\nnamespace = "/PSM1"\n[limits]\nspeed = 0.0', "limits.speed"),
        ('[arm]\nnamespace = "/PSM1"\n[limits]\nspeed = "fast"', "limits.speed"),
        ('[arm]\nnamespace = "/PSM1"\n[force]', "force"),
        ("namespace = ", ""),
    ],
)
def test_a_file_is_checked(tmp_path, text, argument):
    path = tmp_path / "robot.toml"
    path.write_text(text)
    with mistakes.of(f"{path}: {argument}" if argument else str(path)):
        robot_file.read(path)
