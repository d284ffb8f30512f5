"""Every doubt alone, in pairs and none; each is a row of the page's table."""

import itertools
import pathlib
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starjax.core.types import Pose
from starjax.deploy import guard

PAGE = pathlib.Path(__file__).parents[2] / "docs" / "use" / "real-robot.md"
TROCAR = np.array([0.01, -0.02, 0.15])
DOWN = np.diag([1.0, -1.0, -1.0])
TIP = Pose(DOWN, TROCAR - [0.0, 0.0, 0.1])
LIMITS = np.array([[-1.0, 1.0]] * 2)
NOW = 100.0
SOUND = guard.Snapshot(
    TIP, TIP, NOW - 0.1, NOW - 0.1, TROCAR, joints=np.zeros(2), limits=LIMITS, p_joints=TIP.p
)
SENT = [TIP, TIP]


def at(p, x=0.0, y=0.0, z=0.0):
    return p + np.array([x, y, z])


def aside(pose, x):
    return Pose(pose.R, at(pose.p, x))


# Name -> fields within the bound, and beyond it.
ROWS = {
    "stale pose": ({"stamp": NOW - 0.19}, {"stamp": NOW - 0.21}),
    "stale image": ({"image_stamp": NOW + 0.01}, {"image_stamp": NOW - 0.21}),
    "state": ({"is_ready": True}, {"is_ready": False}),
    "commander": ({"commanders": 0}, {"commanders": 1}),
    "trocar": ({"shaft": aside(TIP, 0.0029)}, {"shaft": aside(TIP, 0.0031)}),
    "moved trocar": (
        {"p_world_trocar": at(TROCAR, z=9e-4)},
        {"p_world_trocar": at(TROCAR, z=11e-4)},
    ),
    "following": (
        {"pose": aside(TIP, 0.0039), "p_joints": at(TIP.p, 0.0039)},
        {"pose": aside(TIP, 0.0041), "p_joints": at(TIP.p, 0.0041)},
    ),
    "joints": ({"joints": np.array([0.9, -0.9])}, {"joints": np.array([0.0, -1.1])}),
    "frames": ({"p_joints": at(TIP.p, y=0.0019)}, {"p_joints": at(TIP.p, y=0.0021)}),
}


def names(snapshot, sent=SENT, **bounds):
    doubts = guard.check(snapshot, sent, TROCAR, NOW, guard.Tolerances(**bounds))
    assert all(doubt.text and "\n" not in str(doubt) for doubt in doubts)
    return [doubt.name for doubt in doubts]


def test_a_sound_robot_has_none():
    assert names(SOUND) == []
    assert names(guard.Snapshot(TIP)) == []  # no doubt without a measurement


@pytest.mark.parametrize("name", ROWS)
def test_a_doubt_begins_at_its_bound(name):
    within, beyond = ROWS[name]
    assert names(SOUND._replace(**within)) == []
    assert names(SOUND._replace(**beyond)) == [name]


@pytest.mark.parametrize("pair", list(itertools.combinations(ROWS, 2)))
def test_no_doubt_hides_another(pair):
    changed = {key: value for name in pair for key, value in ROWS[name][1].items()}
    if len(changed) == sum(len(ROWS[name][1]) for name in pair):  # doubts of different fields
        assert sorted(names(SOUND._replace(**changed))) == sorted(pair)


@pytest.mark.parametrize(
    "pose",
    [
        None,
        Pose(DOWN, TIP.p * np.nan),
        Pose(2.0 * DOWN, TIP.p),
        Pose(np.diag([1.0, 1.0, -1.0]), TIP.p),
    ],
)
def test_what_is_no_pose_is_the_only_doubt(pose):
    assert names(SOUND._replace(pose=pose)) == ["pose"]


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("field", ["stamp", "image_stamp", "p_world_trocar", "joints", "p_joints"])
def test_nothing_that_is_not_finite_passes(field, value):
    changed = np.full_like(np.asarray(getattr(SOUND, field), float), value)
    assert len(names(SOUND._replace(**{field: changed}))) == 1


def test_stamps_of_the_future_are_of_another_clock():
    assert names(SOUND._replace(stamp=NOW + 0.03)) == ["stale pose"]


def test_only_images_doubt_the_view():
    kinds = {}
    for name, (_, beyond) in ROWS.items():
        (doubt,) = guard.check(SOUND._replace(**beyond), SENT, TROCAR, NOW)
        kinds[name] = doubt.kind
    assert {name for name, kind in kinds.items() if kind == "view"} == {"stale image"}


def test_an_arm_may_be_late_by_some_commands():
    """It is compared with the nearest of the last ones, and with none before the first."""
    far = aside(TIP, 0.02)
    assert names(SOUND, [TIP, far, far]) == [] and names(SOUND, [far, far, far]) == ["following"]
    assert names(SOUND, []) == []


def test_a_still_arm_is_in_doubt_though_every_plan_begins_at_its_tip():
    count, no_plan = guard.WATCHED, guard.FOLLOWED
    sent = [aside(TIP, 0.0002 * (i % 8)) for i in range(count)]

    def found(tips, commands=sent, **bounds):
        tolerances = guard.Tolerances(**bounds)
        return [x.name for x in guard.check(SOUND, commands, TROCAR, NOW, tolerances, tips)]

    still, slow = [TIP.p] * count, [at(TIP.p, 0.0002 * (i % 2)) for i in range(count)]
    assert found(still) == ["stall"] and found(slow) == []
    assert found(still[1:], sent[1:]) == [] and found(still, [TIP] * count) == []
    late = [TIP] * (count - no_plan) + sent[-no_plan:]  # the arm has not seen the last ones
    assert found(still, late) == []
    assert found(still, max_following=0.01) == [] == found(still, max_following=np.inf)
    # Of two arms, one moves.
    both = [Pose(np.stack([DOWN] * 2), np.stack([x.p, at(x.p, 0.1)])) for x in sent]
    place = Pose(both[0].R, both[0].p)
    halves = [np.stack([x.p, at(TIP.p, 0.1)]) for x in sent]
    (doubt,) = guard.check(
        guard.Snapshot(place), both, np.stack([TROCAR] * 2), NOW, guard.TOLERANCES, halves
    )
    assert doubt.name == "stall" and doubt.kind == "arm"


def test_of_several_arms_the_worst_counts():
    two = Pose(np.stack([DOWN, DOWN]), np.stack([TIP.p, at(TIP.p, 0.1)]))
    trocars = np.stack([TROCAR, at(TROCAR, 0.104)])
    (doubt,) = guard.check(guard.Snapshot(two, two), [two], trocars, NOW)
    assert doubt.name == "trocar" and "4 mm" in doubt.text


def test_the_owner_chooses_the_bounds():
    for name, bound in (("trocar", "max_off_trocar"), ("following", "max_following")):
        assert names(SOUND._replace(**ROWS[name][1]), **{bound: 0.01}) == []
    assert names(SOUND, max_age_s=0.05) == ["stale pose", "stale image"]
    assert names(SOUND._replace(**ROWS["moved trocar"][1]), max_moved=0.01) == []


def test_the_first_command_is_compared_with_the_setpoint():
    assert guard.check_first(aside(TIP, 0.0029), TIP) == []
    (doubt,) = guard.check_first(aside(TIP, 0.326), TIP)
    assert doubt.kind == "arm" and "326 mm" in doubt.text
    assert guard.check_first(aside(TIP, np.nan), TIP)


@pytest.mark.parametrize(("angle", "count"), [(0.09, 0), (0.11, 1), (np.pi, 1), (np.nan, 1)])
def test_a_first_command_with_other_axes_is_a_doubt(angle, count):
    turn = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix() if angle == angle else np.nan
    doubts = guard.check_first(Pose(TIP.R @ (turn * np.eye(3)), TIP.p), TIP)
    assert len(doubts) == count and all(doubt.name == "first command" for doubt in doubts)


def test_the_page_has_a_row_for_each():
    rows = set(re.findall(r"^\| `([^`]+)` \|", PAGE.read_text(), re.MULTILINE))
    assert {*ROWS, "pose", "first command"} <= rows
