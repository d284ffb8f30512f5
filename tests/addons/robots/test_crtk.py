"""Messages of a surgical robot and our structs: there and back, in any frames."""

import types

import mistakes
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starjax.addons.robots import crtk, psm
from starjax.core.errors import UsageError
from starjax.core.types import Pose

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


@pytest.mark.parametrize("seed", range(5))
def test_an_older_message_is_read_and_written(seed):
    """TransformStamped, which `_cp` topics had until 2023."""
    pose, frames = drawn(seed), crtk.Frames(drawn(100 + seed), drawn(200 + seed), "base")
    parts = message().pose
    older = types.SimpleNamespace(
        header=types.SimpleNamespace(frame_id=""),
        transform=types.SimpleNamespace(translation=parts.position, rotation=parts.orientation),
    )
    sent = crtk.fill_pose(older, pose, frames)
    assert sent.header.frame_id == "base"
    np.testing.assert_allclose(crtk.pose_of(sent, frames).p, pose.p, atol=1e-12)


def test_a_header_has_the_name_of_its_frame():
    pose, stamped = drawn(0), message()
    stamped.header = types.SimpleNamespace(
        frame_id="", stamp=types.SimpleNamespace(sec=7, nanosec=5 * 10**8)
    )
    with mistakes.of("frames.frame_id"):  # empty: a dVRK's endoscope
        crtk.fill_pose(stamped, pose, AT)
    named = AT._replace(frame_id="PSM1_base")
    assert crtk.fill_pose(stamped, pose, named).header.frame_id == "PSM1_base"
    np.testing.assert_allclose(crtk.pose_of(stamped, named).p, pose.p, atol=1e-12)
    for other in ("ECM", ""):
        stamped.header.frame_id = other
        with mistakes.of("measured_cp.header.frame_id"):
            crtk.pose_of(stamped, named)
    assert crtk.stamp_of(stamped) == 7.5


def test_the_base_in_the_endoscope_is_between_two_measurements():
    view_base, tip = drawn(1), drawn(2)
    local = crtk.fill_pose(message(), tip, AT)
    viewed = crtk.fill_pose(message(), crtk.compose(view_base, tip), AT)
    found = crtk.pose_view_base(viewed, local)
    np.testing.assert_allclose(found.p, view_base.p, atol=1e-12)
    np.testing.assert_allclose(found.R, view_base.R, atol=1e-12)


@pytest.mark.parametrize("names", psm.NAMES)
def test_joints_have_the_names_of_the_robot(names):
    measured = types.SimpleNamespace(name=list(names), position=[0.1 * i for i in range(6)])
    assert crtk.names_of(measured, psm.NAMES) == names
    measured.name[0] = "elbow"
    with mistakes.of("measured_js.name"):
        crtk.names_of(measured, psm.NAMES)


DOWN = np.diag([1.0, -1.0, -1.0])


@pytest.mark.parametrize(
    ("R", "p", "argument"),
    [
        (DOWN, [0.0, 0.0, -100.0], "pose_base_tip.p"),  # mm
        (DOWN, [0.0, 0.0, np.nan], "pose_base_tip.p"),
        (2.0 * DOWN, [0.0, 0.0, -0.1], "pose_base_tip.R"),
        (-DOWN, [0.0, 0.0, -0.1], "pose_base_tip.R"),  # mirrored
        (DOWN * np.nan, [0.0, 0.0, -0.1], "pose_base_tip.R"),
        (DOWN[:2], [0.0, 0.0, -0.1], "pose_base_tip"),
    ],
)
def test_a_tip_that_is_none_has_no_joints(R, p, argument):
    with mistakes.of(argument):
        psm.joints_of(Pose(np.array(R), np.array(p)), psm.LARGE_NEEDLE_DRIVER)


@pytest.mark.parametrize(
    "q", [[30.0, 5.0, 0.1, 20.0, 0.0, 0.0], [0.1, 0.1, 120.0, 0.0, 0.0, 0.0], [np.nan] * 6]
)
def test_joints_in_degrees_or_mm_are_none(q):
    for use in (psm.tip_of, psm.shaft_of):
        with mistakes.of("q"):
            use(np.array(q), psm.PROGRASP)


def test_joints_come_back_in_double_precision():
    rng = np.random.default_rng(0)
    low, high = [-1.5, -0.9, 0.03, -3.0, -1.3, -1.3], [1.5, 0.9, 0.24, 3.0, 1.3, 1.3]
    for q in rng.uniform(low, high, (500, 6)):
        found = psm.joints_of(psm.tip_of(q, psm.LARGE_NEEDLE_DRIVER), psm.LARGE_NEEDLE_DRIVER)
        np.testing.assert_allclose(found, q, atol=1e-9)
        tip = psm.tip_of(q, psm.LARGE_NEEDLE_DRIVER)
        assert np.abs(psm._angles(*tip, psm.LARGE_NEEDLE_DRIVER.wrist) - q[4:]).max() < 1e-9
