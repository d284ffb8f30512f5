"""Messages of a surgical robot and our structs: there and back, in any frames."""

import types

import mistakes
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starjax.addons.robots import crtk, psm
from starjax.errors import UsageError
from starjax.types import Pose

AT = crtk.Frames(Pose(np.eye(3), np.zeros(3)), Pose(np.eye(3), np.zeros(3)))


def message():
    """As a PoseStamped: attributes, and nothing of ROS."""
    vector = types.SimpleNamespace(x=0.0, y=0.0, z=0.0)
    turn = types.SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    return types.SimpleNamespace(pose=types.SimpleNamespace(position=vector, orientation=turn))


def drawn(seed):
    rng = np.random.default_rng(seed)
    return Pose(Rotation.random(random_state=seed).as_matrix(), rng.uniform(-1.0, 1.0, 3))


@pytest.mark.parametrize("seed", range(20))
def test_a_pose_comes_back_in_any_frames(seed):
    pose, frames = drawn(seed), crtk.Frames(drawn(100 + seed), drawn(200 + seed))
    sent = crtk.fill_pose(message(), pose, frames)
    again = crtk.pose_of(sent, frames)
    np.testing.assert_allclose(again.R, pose.R, atol=1e-12)
    np.testing.assert_allclose(again.p, pose.p, atol=1e-12)
    np.testing.assert_allclose(crtk.pose_of(sent.pose, frames).p, pose.p, atol=1e-12)


def test_a_quaternion_is_read_x_y_z_w():
    sent, nothing = message(), Pose(np.eye(3), np.zeros(3))
    half = np.sqrt(0.5)
    sent.pose.orientation = types.SimpleNamespace(x=0.0, y=0.0, z=half, w=half)
    sent.pose.position.x = 0.2
    base = Pose(np.eye(3), np.array([0.0, 0.0, 1.0]))
    pose = crtk.pose_of(sent, crtk.Frames(base, nothing))
    np.testing.assert_allclose(pose.R[:, 0], [0.0, 1.0, 0.0], atol=1e-12)  # a quarter about z
    np.testing.assert_allclose(pose.p, [0.2, 0.0, 1.0])
    # 1 cm further along the tool's x, which points along the base's y now
    tip = crtk.Frames(base, Pose(np.eye(3), np.array([0.01, 0.0, 0.0])))
    np.testing.assert_allclose(crtk.pose_of(sent, tip).p, [0.2, 0.01, 1.0])


@pytest.mark.parametrize(
    ("part", "values", "argument"),
    [
        ("position", {"x": np.nan, "y": 0.0, "z": 0.0}, "measured_cp.position"),
        ("orientation", {"x": 0.0, "y": 0.0, "z": 0.0, "w": 0.0}, "measured_cp.orientation"),
        ("orientation", {"x": 0.0, "y": np.nan, "z": 0.0, "w": 1.0}, "measured_cp.orientation"),
    ],
)
def test_what_is_no_pose_is_named(part, values, argument):
    sent = message()
    setattr(sent.pose, part, types.SimpleNamespace(**values))
    with pytest.raises(UsageError) as caught:
        crtk.pose_of(sent, crtk.Frames(drawn(0), drawn(1)))
    assert caught.value.argument == argument


def test_jaws_open_and_close():
    jaw = crtk.Jaw(closed=-0.2, open=1.0)
    for gripper in (-1.0, -0.25, 0.0, 1.0):
        sent = crtk.fill_jaw(types.SimpleNamespace(position=[]), gripper, jaw)
        assert jaw.closed <= sent.position[0] <= jaw.open
        assert crtk.opening_of(sent, jaw) == pytest.approx(gripper)
    assert crtk.fill_jaw(types.SimpleNamespace(), 3.0, jaw).position == [1.0]
    assert crtk.opening_of(types.SimpleNamespace(position=[-0.5]), jaw) == -1.0
    for positions in ([], [0.1, 0.2], [np.inf]):
        with pytest.raises(UsageError) as caught:
            crtk.opening_of(types.SimpleNamespace(position=positions), jaw)
        assert caught.value.argument == "jaw/measured_js.position"
    with pytest.raises(UsageError):
        crtk.opening_of(types.SimpleNamespace(position=[0.1]), crtk.Jaw(0.5, 0.5))


@pytest.mark.parametrize(
    ("state", "homed", "busy", "ready"),
    [
        ("ENABLED", True, False, True),
        ("ENABLED", False, False, False),
        ("ENABLED", True, True, False),
        ("PAUSED", True, False, False),
        ("FAULT", True, False, False),
    ],
)
def test_an_arm_is_moved_only_where_it_says_that_it_may(state, homed, busy, ready):
    said = types.SimpleNamespace(state=state, is_homed=homed, is_busy=busy)
    assert crtk.is_ready(said) is ready


def test_joints_are_read_by_name_and_written_in_order():
    names = ("outer_yaw", "outer_pitch", "outer_insertion")
    sent = types.SimpleNamespace(name=["jaw", *names[::-1]], position=[0.5, 0.1, -0.2, 0.3])
    q = crtk.joints_of(sent, names)
    np.testing.assert_array_equal(q, [0.3, -0.2, 0.1])
    again = crtk.fill_joints(types.SimpleNamespace(name=[], position=[]), q, names)
    assert again.name == list(names) and again.position == q.tolist()
    with mistakes.of("measured_js.name", "outer_yaw"):
        crtk.joints_of(types.SimpleNamespace(name=["outer_yaw"], position=[0.0]), names)
    sent.position[1] = np.nan
    with mistakes.of("measured_js.position", "nan"):
        crtk.joints_of(sent, names)


NAN = float("nan")


@pytest.mark.parametrize(
    ("argument", "fill"),
    [
        ("servo_cp.position", lambda sent: crtk.fill_pose(sent, Pose(np.eye(3), [0, NAN, 0]), AT)),
        (
            "servo_cp.orientation",
            lambda sent: crtk.fill_pose(sent, Pose(0 * np.eye(3), [0] * 3), AT),
        ),
        ("servo_cp.orientation", lambda sent: crtk.fill_pose(sent, Pose(-np.eye(3), [0] * 3), AT)),
        ("gripper", lambda sent: crtk.fill_jaw(sent, NAN, crtk.Jaw(0.0, 1.0))),
        ("servo_jp.position", lambda sent: crtk.fill_joints(sent, [NAN] * 6, psm.JOINTS)),
        ("servo_jp.position", lambda sent: crtk.fill_joints(sent, [0.0] * 5, psm.JOINTS)),
    ],
)
def test_what_no_robot_should_get_is_not_written(argument, fill):
    sent, before = message(), message()
    with mistakes.of(argument):
        fill(sent)
    assert sent == before


def test_a_wrong_number_of_joints_is_named():
    q = np.zeros(5)
    uses = (
        lambda: psm.tip_of(q, psm.PROGRASP),
        lambda: psm.shaft_of(q, psm.PROGRASP),
        lambda: psm.half_turn(q),
    )
    for use in uses:
        with mistakes.of("q", "5"):
            use()
    short = types.SimpleNamespace(name=list(psm.JOINTS), position=[0.0] * 4)
    with mistakes.of("measured_js.position", "0.0"):
        crtk.joints_of(short, psm.JOINTS)
