"""Faults between a node and its robot: doubts, kills, two commanders, commands out of reach."""

import dataclasses
import pathlib
import subprocess
import sys
import time
import types

import mistakes
import numpy as np
import pytest

pytest.importorskip("cyclonedds")

from loopback import HOME, file_of, later, made, robot

from starjax.addons.robots import (
    arm,
    bus,
    messages,
    node,
    psm,
    topic_table,
)


def until(holds, seconds=60.0):
    end = time.monotonic() + seconds
    while not (is_so := holds()) and time.monotonic() < end:
        time.sleep(0.002)
    return is_so


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
    assert told["commands"] <= sent and told["moved"] < 0.005 and told["holds"] == 1


def test_a_robot_that_is_killed_and_back_elsewhere_is_not_pulled(own_bus, tmp_path, monkeypatch):
    with robot() as first, made(own_bus, file_of(tmp_path)) as (one, client, _):
        order, refresh = [], one.refresh
        monkeypatch.setattr(one, "refresh", lambda: (order.append(one.sent), refresh()))
        stop = iter([False] * 20 + [True])
        node.run(one, client, 5.0, should_stop=lambda: next(stop))
        assert order == [0]  # before the first command
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


def test_measurements_are_awaited_anew():
    """A robot came back elsewhere, and the kept measurements are of the one before."""
    polls = iter([["/jaw"], ["/pose"], [], ["/pose"], ["/joints"], ["/later"]])
    sources = {name: arm.TopicSource(f"/{name}", None) for name in ("pose", "joints", "jaw")}
    arm.CrtkArm.refresh(types.SimpleNamespace(sources=sources, poll=lambda: next(polls)))
    assert next(polls) == ["/later"]


@pytest.mark.slow
def test_a_killed_node_leaves_an_arm_that_holds_and_a_second_begins(own_bus, tmp_path):
    file = file_of(tmp_path)
    code = f"import sys; sys.path.insert(0, {str(pathlib.Path(__file__).parents[1])!r})\n"
    code += f"import loopback; loopback.drive({str(tmp_path / 'robot.toml')!r})"
    for name in ("setpoint_js", "measured_js"):
        own_bus.read(f"/PSM1/{name}", messages.JointState)

    def joints(name):
        own_bus.poll()
        message = own_bus.newest.get(f"/PSM1/{name}")
        return HOME if message is None else np.array(message.position)

    with robot() as process:
        first = subprocess.Popen([sys.executable, "-c", code])
        try:
            assert until(lambda: np.abs(joints("setpoint_js") - HOME).max() > 0.02)
        finally:
            first.kill()
            first.wait()
        assert until(lambda: (joints("setpoint_js") == joints("measured_js")).all())
        held, begun = joints("measured_js"), own_bus.now()
        assert until(lambda: own_bus.now() > begun + 0.5)
        np.testing.assert_array_equal(joints("setpoint_js"), held)
        with made(own_bus, file) as (one, client, _):
            # The killed program counts as a commander for 10 s.
            assert until(lambda: bool(one.poll()) and not node.doubts(one, client))
            report = node.run(one, client, 1.0)
            assert report.fault == "" and one.sent == 120
        assert process.end()["moved"] < 0.005


def test_a_wrong_instrument_is_found_before_anything_is_sent(own_bus, tmp_path):
    file = file_of(tmp_path, arm='instrument = "prograsp"')
    with robot() as process, made(own_bus, file) as (one, client, _):
        assert "frames" in [doubt.name for doubt in node.doubts(one, client)]
        assert node.run(one, client, 1.0).fault.startswith("frames")
        assert one.sent == 0 and process.end()["commands"] == 0


def test_a_wrong_base_is_found_by_the_setpoint(own_bus, tmp_path, monkeypatch):
    """Measurements agree in any base; the robot's own setpoint does not."""
    with robot() as process, made(own_bus, file_of(tmp_path)) as (one, client, _):
        command = client.step(one.measure())
        assert one.check_first(command) == []
        aside = command._replace(pose=command.pose._replace(p=command.pose.p + 0.01))
        (doubt,) = one.check_first(aside)
        assert doubt.name == "first command"
        monkeypatch.setattr(one, "check_first", lambda command: [doubt])
        report = node.run(one, client, 1.0)
        assert report.fault == str(doubt) and report.silent == 1 and one.sent == 0
        assert process.end()["holds"] == 0  # the arm was not ours yet


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


def test_a_command_out_of_reach_is_not_sent(own_bus, tmp_path, monkeypatch):
    with robot() as process, made(own_bus, file_of(tmp_path)) as (one, client, _):
        command = client.step(one.measure())
        deep = command._replace(pose=command.pose._replace(p=command.pose.p - [0.0, 0.0, 0.2]))
        with mistakes.of("outer_insertion"):
            one.send(deep)
        far = one.kinematics._replace(joints_of=lambda pose, near: near + 0.21)
        monkeypatch.setattr(one, "kinematics", far)
        report = node.run(one, client, 1.0)
        assert report.fault.startswith("out of reach: joints") and report.silent == 1
        assert one.sent == 0
        process.end()


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


def test_a_simulated_arm_refuses_joints_beyond_their_limits_and_leaves_its_last_message(own_bus):
    joints, text = messages.JointState, messages.StringStamped
    own_bus.read("/PSM1/measured_js", joints)
    own_bus.read("/PSM1/warning", text)
    for topic in ("/PSM1/measured_js", "/PSM1/warning"):
        own_bus.newest.pop(topic, None)
    writer = own_bus.writer("/PSM1/servo_jp", joints, "servo")
    with robot() as process:
        deep = HOME + np.eye(6)[2]  # 1 m of insertion

        def is_refused():
            writer.write(joints(messages.Header(), list(psm.JOINTS), deep.tolist()))
            return "/PSM1/warning" in own_bus.poll()

        assert until(is_refused)
        assert "within their limits" in own_bus.newest["/PSM1/warning"].string
        told = process.end()
        assert told["commands"] == 0 and np.abs(np.array(told["q"]) - HOME).max() == 0.0
        until(lambda: own_bus.poll() and False, 0.5)
        assert len(own_bus.newest["/PSM1/measured_js"].position) == 6
