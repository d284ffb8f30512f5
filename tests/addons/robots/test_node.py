"""A policy's node on topics: motion, pictures, markers, files of robots."""

import dataclasses
import io
import resource

import mistakes
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

pytest.importorskip("cyclonedds")

from loopback import BASE, HOME, file_of, made, robot

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


def test_a_dry_run_sends_nothing(own_bus, tmp_path):
    with robot() as process, made(own_bus, file_of(tmp_path), is_dry=True) as (one, client, _):
        report = node.run(one, client, 1.0, is_dry=True)
        assert report.plans >= 2 and one.sent == 0 and process.end()["commands"] == 0


@pytest.mark.slow
@pytest.mark.parametrize("minutes", [2, pytest.param(10, marks=pytest.mark.release)])
def test_a_redundant_arm_does_not_drift(own_bus, tmp_path, minutes):
    """Joints of a seven-joint arm after a round of 4 s are those after the first few."""
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

        report = node.run(one, client, 60.0 * minutes, should_stop=look)
        process.end()
    assert report.fault == "" and report.silent == 0 and report.steps == 1_800 * minutes
    assert max(errors) < 2e-4  # m
    drift = np.abs(np.array(joints[5:]) - joints[5]).max()
    assert len(joints) == 15 * minutes and drift < 2e-3 * minutes, drift  # rad
    assert sizes[-1] - sizes[10] < 2_000 * minutes  # KiB


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
        ('[arm]\nnamespace = "/PSM1"\nposition = ["a", 0, 0]', "arm.position"),
        ('[arm]\nnamespace = "/PSM1"\n[network]\npeers = [1]', "network.peers"),
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
