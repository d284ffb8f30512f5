"""Scenes with contact behind topics: one control period, and tasks done by packaged policies."""

import re
import subprocess
import sys
import time

import numpy as np
import pytest

pytest.importorskip("cyclonedds")

from loopback import DOMAIN

from starjax.addons.robots import bus, robot_file, scene_body, sim_arm, sim_robot

# Arm, instrument, task, policy and camera, as in the policies' training.
TASKS = [
    ("fr5", "grasper", "peg_transfer", "compact", "camera"),
    ("psm", "large_needle_driver", "needle_drive", "needle_drive", "camera_near"),
]


@pytest.fixture(scope="module")
def body():
    return scene_body.SceneBody("reach", "psm", "large_needle_driver", image_size=16)


@pytest.mark.slow  # compiles
def test_a_body_goes_to_its_goal_and_shows_pictures_at_30_hz(body):
    """Joints by the topics' kinematics are those of the scene, wrist included."""
    goal = body.q + np.linspace(0.002, 0.006, len(body.q))
    shown = 0
    for _ in range(4 * 8):
        before = body.q
        body.step(goal, 0.0)
        assert np.abs(body.q - before).max() < 0.02
        shown += bool(body.images())
    np.testing.assert_allclose(body.q, goal, atol=2e-3)
    assert shown == 8 and body.is_sound and not body.is_success
    tip = body.kinematics.tip_of(body.q)
    R = body.pose_world_base.R @ tip.R
    np.testing.assert_allclose(R, body.state.pose.R[0], atol=1e-4)


@pytest.mark.slow
def test_the_file_of_a_scene_is_that_of_its_robot(body, tmp_path):
    args = sim_robot.SimRobotArgs(arm="psm", task="reach", namespace="/PSM2")
    network = robot_file.Network(3, "lo", use_sim_time=True)
    file = sim_robot._file_of(args, body, network)
    path = tmp_path / "sim.toml"
    path.write_text(robot_file.text(file))
    again = robot_file.read(path)
    assert again == file and again.arm.frame == sim_arm.frame_of("/PSM2")
    trocar = np.asarray(body.state.trocar.p_world_trocar[0])
    np.testing.assert_allclose(again.p_world_trocar, trocar, atol=1e-6)


def test_a_simulators_time_stands_then_goes_on(monkeypatch):
    """A slow simulator is waited for; a dead one becomes old."""
    own = bus.Bus(robot_file.Network(DOMAIN, "lo", use_sim_time=True))
    begun = own.now()
    assert own.now() == begun == 0.0
    later = own._ticked + 5.0
    monkeypatch.setattr(time, "monotonic", lambda: later)
    assert own.now() == pytest.approx(3.0, abs=0.1)


@pytest.mark.release
@pytest.mark.parametrize(("arm", "instrument", "task", "policy", "camera"), TASKS)
def test_a_packaged_policy_does_its_task_over_topics(
    tmp_path, arm, instrument, task, policy, camera
):
    """Two processes, by the commands; the task's own strict success judges."""
    file, command = tmp_path / "sim.toml", [sys.executable, "-m", "starjax"]
    flags = ["--arm", arm, "--instrument", instrument, "--task", task, "--camera", camera]
    flags += ["--domain", str(DOMAIN), "--file", str(file)]
    pipes = {"stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([*command, "sim-robot", *flags], **pipes) as sim:
        try:
            assert "topics" in sim.stdout.readline()
            run = ["robot", str(file), "--policy", policy, "--begin", "--seconds", "60"]
            node = subprocess.run([*command, *run], timeout=900, **pipes)
            sim.terminate()
            told = sim.communicate(timeout=60)[0]
        finally:
            sim.kill()
    assert node.returncode == 0, node.stdout
    assert f"{task}: success" in told, told
    assert float(re.search(r"largest step ([\d.]+) mm", told).group(1)) < 10.0
