"""Demonstrations of others: one dataset for all conventions; anomalies are reported."""

import json
import shutil

import kill
import mistakes
import numpy as np
import pytest
import recorded
from msgspec import structs
from scipy.spatial import transform
from strangers import (
    ARM,
    MAP,
    ORIGIN,
    RNG,
    SECONDS,
    TIP,
    TIP_TURN,
    TROCARS,
    TURN,
    bring,
    moved,
    source,
    wxyz,
)

from starjax import rcm
from starjax.addons.formats import (
    base,
    exchange,
    foreign,
    mapping,
    motion,
    timing,
    tip_poses,
    trocars,
)
from starjax.addons.formats.mapping import ArmColumns, CameraColumn, Map, ShaftColumns
from starjax.core import errors
from starjax.data import anomalies, load, schema, store


def loaded(root):
    return load.load(root, residency="host", report=lambda _: None).dataset


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    root = tmp_path_factory.mktemp("plain")
    return bring(root), root / "d"


def test_it_is_a_dataset_like_any_other(plain):
    found, root = plain
    dataset = loaded(root)
    assert (found.episodes, found.left_out, found.frames) == (3, 0, 360) and not found.notes
    R, p, jaws = moved(np.arange(120) / 30, TROCARS[1], 2)
    np.testing.assert_allclose(dataset.observation.pose.p[240:, 0], p, atol=1e-7)
    np.testing.assert_allclose(dataset.observation.pose.R[240:, 0], R, atol=1e-6)
    np.testing.assert_allclose(dataset.observation.gripper[240:, 0], jaws, atol=1e-6)
    np.testing.assert_allclose(dataset.command.pose.p[240:-1, 0], p[1:], atol=1e-7)
    np.testing.assert_allclose(dataset.trocar.p_world_trocar[:, 0], TROCARS[[0, 0, 1]], atol=5e-6)
    assert store.keys(root) == ["0000-0000-0", "0000-0001-0", "0001-0000-0"]
    description = store.read_description(root)
    assert description["imported"]["mapping"]["arms"][0]["position"] == "p0"


@pytest.mark.parametrize(("share", "doubts"), [(0.0, 0), (1.0, 0), (0.3, 1)])
def test_jaws_that_stay_closed_or_open_are_no_doubt(tmp_path, share, doubts):
    value = ARM.gripper_closed + share * (ARM.gripper_open - ARM.gripper_closed)
    given = source(change=lambda arrays: arrays | {"jaws0": np.full_like(arrays["jaws0"], value)})
    found = bring(tmp_path, given)
    assert sum("gripper" in note for note in found.notes) == doubts


def written_as(kind):
    """The first arm's rotations as numbers of that kind."""

    def change(arrays):
        rotation = transform.Rotation.from_matrix(arrays["R0"])
        signs = np.where(np.arange(len(arrays["time"])) % 7 < 3, -1.0, 1.0)[:, None]
        xyzw = signs * rotation.as_quat()  # one rotation, two quaternions
        vector = rotation.as_rotvec()
        whole = 2 * np.pi * vector / np.linalg.norm(vector, axis=-1, keepdims=True)
        numbers = {
            "quat_xyzw": xyzw,
            "quat_wxyz": xyzw[:, [3, 0, 1, 2]],
            "matrix": arrays["R0"].reshape(-1, 9),
            "rot6d": arrays["R0"][:, :, :2].swapaxes(1, 2).reshape(-1, 6),
            "rotvec": np.where(signs > 0, vector, vector + whole),  # beyond a whole turn
            "euler_xyz": rotation.as_euler("xyz") + 2 * np.pi * (signs > 0),
        }
        return arrays | {"R0": numbers[kind]}

    return change


@pytest.mark.parametrize("kind", mapping.NUMBERS)
@pytest.mark.parametrize("hz", [30.0, 50.0])
def test_every_way_to_write_a_rotation_is_the_same_motion(kind, hz):
    """At another rate too, at which wrapped angles would be averaged."""
    given = source(hz=hz, change=written_as(kind))
    made = structs.replace(MAP, arms=(structs.replace(ARM, rotation_as=kind),))
    found = motion.read(given.read(0, mapping.names(made)), made, hz, None)
    times = np.arange(len(found.gripper)) / 30
    R, p, jaws = moved(times, TROCARS[0], 0)
    assert abs(len(times) - 120) <= 1
    np.testing.assert_allclose(found.pose.p[:, 0], p, atol=2e-5)
    np.testing.assert_allclose(found.pose.R[:, 0], R, atol=1e-4)
    np.testing.assert_allclose(found.command.p[:-1, 0], p[1:], atol=2e-5)
    np.testing.assert_allclose(found.gripper[:, 0], jaws, atol=1e-4)
    assert not found.notes


def test_units_frames_and_tips_of_others(plain, tmp_path):
    def change(arrays):
        R, p = arrays["R0"], arrays["p0"]
        theirs = TURN.inv().as_matrix() @ R @ TIP_TURN.inv().as_matrix()
        at = TURN.inv().apply(p - ORIGIN) - theirs @ TIP
        return arrays | {
            "pose": np.concatenate([1000 * at, theirs.reshape(-1, 9)], -1).astype(np.float64),
            "jaws0": np.rad2deg(0.25 * (arrays["jaws0"] + 1.0)),
        }

    arm = structs.replace(
        ARM,
        position="pose[0:3]",
        rotation="pose[3:12]",
        gripper_closed=0.0,
        gripper_open=float(np.rad2deg(0.5)),
        tip=tuple(TIP.tolist()),
        tip_turn=wxyz(TIP_TURN),
    )
    made = structs.replace(
        MAP, units="mm", origin=tuple(ORIGIN.tolist()), turn=wxyz(TURN), arms=(arm,)
    )
    bring(tmp_path, source(change=change), made)
    one, other = loaded(tmp_path / "d"), loaded(plain[1])
    for ours, theirs in zip(one.observation.pose + one.command.pose, other.observation.pose * 2):
        np.testing.assert_allclose(ours[:100], theirs[:100], atol=0.05)
    np.testing.assert_allclose(one.observation.pose.p, other.observation.pose.p, atol=1e-6)
    np.testing.assert_allclose(one.observation.pose.R, other.observation.pose.R, atol=1e-6)
    np.testing.assert_allclose(one.observation.gripper, other.observation.gripper, atol=1e-6)
    np.testing.assert_allclose(one.trocar.p_world_trocar, other.trocar.p_world_trocar, atol=1e-5)


def test_a_robots_joints_give_its_tip(tmp_path):
    (tmp_path / "robot.xml").write_text(
        """<mujoco><worldbody><body name="base" pos="0 0 0.1"><joint name="a" axis="0 0 1"/>
        <geom size="0.01"/><body name="arm" pos="0.2 0 0"><joint name="b" axis="0 1 0"/>
        <geom size="0.01"/><site name="tip" pos="0 0 0.1"/></body></body></worldbody></mujoco>"""
    )
    joints = RNG.uniform(-1, 1, (40, 2))
    arrays = {"q": joints[:, ::-1], "state": np.zeros((40, 12))}
    arm = ArmColumns(joints="q", joint_names=("b", "a"), model="robot.xml", body="tip")
    found = motion.read(arrays, structs.replace(MAP, arms=(arm,)), 30.0, tmp_path)
    first = transform.Rotation.from_euler("z", joints[:, :1])
    second = first * transform.Rotation.from_euler("y", joints[:, 1:])
    p = np.array([0, 0, 0.1]) + first.apply([0.2, 0, 0]) + second.apply([0, 0, 0.1])
    np.testing.assert_allclose(found.pose.p[:, 0], p, atol=1e-12)
    np.testing.assert_allclose(found.pose.R[:, 0], second.as_matrix(), atol=1e-12)
    on_arm = ShaftColumns(body="arm", turn=wxyz(TIP_TURN))
    both = structs.replace(MAP, arms=(structs.replace(arm, shaft=on_arm),))
    shaft = motion.read(arrays, both, 30.0, tmp_path).shaft
    p = np.array([0, 0, 0.1]) + first.apply([0.2, 0, 0])
    np.testing.assert_allclose(shaft.p[:, 0], p, atol=1e-12)
    np.testing.assert_allclose(shaft.R[:, 0], (second * TIP_TURN).as_matrix(), atol=1e-12)
    for changed, argument in (
        ({"body": "tap"}, "body"),
        ({"joint_names": ("b", "c")}, "joint_names"),
        ({"joint_names": ("b",)}, "joints"),
        ({"model": "none.xml"}, "model"),
    ):
        bad = structs.replace(MAP, arms=(structs.replace(arm, **changed),))
        with mistakes.of(argument):
            motion.read(arrays, bad, 30.0, tmp_path)


URDF = """
<robot name="r">
  <link name="base"/>
  <link name="l1"><inertial><mass value="0"/>
    <inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/></inertial></link>
  <link name="tool"/>
  <joint name="j1" type="revolute"><parent link="base"/><child link="l1"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="end" type="fixed"><parent link="l1"/><child link="tool"/><origin xyz="0.1 0 0.2"/>
  </joint>
</robot>
"""


def test_a_urdfs_tip_may_be_at_a_fixed_joint_and_its_links_without_mass(tmp_path):
    (tmp_path / "r.urdf").write_text(URDF)
    angles = np.linspace(0.0, 1.0, 9)[:, None]
    arm = ArmColumns(joints="q", model="r.urdf", body="tool")
    _, p = tip_poses._kinematics(angles, arm, arm.body, tmp_path / arm.model)
    c, s = np.cos(angles), np.sin(angles)
    np.testing.assert_allclose(p, np.hstack([0.1 * c, 0.1 * s, 0.2 + 0 * c]), atol=1e-9)


def test_images_that_lose_their_ratio_of_sides_are_named():
    given = source(images=True)  # 12 x 16
    cameras = {"camera": CameraColumn(column="image", size=8)}
    (line,) = foreign._squeezed(given, structs.replace(MAP, cameras=cameras))
    assert "camera" in line and "12 x 16" in line
    for kept in ({"crop": (0, 2, 12, 12)}, {"size": 0}):
        camera = structs.replace(cameras["camera"], **kept)
        assert not list(foreign._squeezed(given, structs.replace(MAP, cameras={"camera": camera})))


def test_uneven_times_with_small_gaps_are_filled_in_and_said(tmp_path):
    times = np.arange(0.0, SECONDS, 1 / 60) + RNG.uniform(-0.002, 0.002, 240)
    times = np.delete(times, slice(100, 108))
    made = structs.replace(MAP, time="time")
    found = bring(tmp_path, source(times, hz=60.0), made)
    dataset = loaded(tmp_path / "d")
    length = int(dataset.length[0])
    _, p, _ = moved(times[0] + np.arange(length) / 30, TROCARS[0], 0)
    np.testing.assert_allclose(dataset.observation.pose.p[:length, 0], p, atol=2e-4)
    assert len(found.notes) == 3 and all("gap" in note for note in found.notes)
    assert json.loads((tmp_path / "d" / schema.IMPORTED).read_text())["notes"] == found.notes


def test_long_gaps_leave_the_episode_out():
    times = np.concatenate([np.arange(60) / 30, 3.0 + np.arange(60) / 30])
    made = structs.replace(MAP, time="time")
    given = source(times)
    with pytest.raises(timing.Gap):
        motion.read(given.read(0, mapping.names(made)), made, 30.0, None)
    patient = structs.replace(made, max_gap_s=2.0)
    assert motion.read(given.read(0, mapping.names(made)), patient, 30.0, None).notes


def test_jumps_and_other_rates_are_said():
    def change(arrays):
        p = arrays["p0"].copy()
        p[50:] += 0.1
        return arrays | {"p0": p}

    made = structs.replace(MAP, time="time")
    given = source(change=change)
    arrays = given.read(0, mapping.names(made))
    (jump,) = motion.read(arrays, made, 30.0, None).notes
    assert "1 jumps" in jump and "1.63 s" in jump
    slow = motion.read(arrays | {"time": 2 * arrays["time"]}, made, 30.0, None).notes
    assert any("15 Hz" in note for note in slow)


def test_what_was_asked_for_is_the_command(tmp_path):
    def change(arrays):
        ahead = {"p0": arrays["p0"] + 0.01, "R0": arrays["R0"], "jaws0": -np.ones(120)}
        return arrays | {f"asked_{name}": array for name, array in ahead.items()}

    arm = structs.replace(
        ARM, command_position="asked_p0", command_rotation="asked_R0", command_gripper="asked_jaws0"
    )
    bring(tmp_path, source(change=change), structs.replace(MAP, arms=(arm,)))
    dataset = loaded(tmp_path / "d")
    offset = dataset.command.pose.p - dataset.observation.pose.p
    np.testing.assert_allclose(offset, 0.01, atol=1e-6)
    np.testing.assert_array_equal(dataset.command.gripper, -1.0)


def test_a_column_may_say_the_trocar(tmp_path):
    def change(arrays):
        return arrays | {"trocar": np.tile([0.01, 0.02, 0.14], (len(arrays["time"]), 1))}

    made = structs.replace(MAP, arms=(structs.replace(ARM, trocar="trocar"),))
    found = bring(tmp_path, source(change=change), made)
    np.testing.assert_allclose(found.p_world_trocar, np.tile([0.01, 0.02, 0.14], (3, 1, 1)))
    assert len(found.notes) == 3 and found.residual_mm.min() > 1e3 * trocars.MISSED  # a false one


def test_a_motion_that_tells_no_trocar_is_left_out_or_shares_one(tmp_path):
    seen = []

    def change(arrays):
        seen.append(0)
        if len(seen) == 2:  # the second episode: no motion but about the shaft
            arrays["R0"] = arrays["R0"][:1] @ transform.Rotation.from_euler(
                "z", arrays["time"][:, None]
            ).as_matrix().reshape(-1, 3, 3)
            arrays["p0"] = np.tile(arrays["p0"][:1], (120, 1))
        return arrays

    given = source(change=change)
    found = bring(tmp_path, given)
    assert (found.episodes, found.left_out) == (2, 1)
    assert len(found.notes) == 1 and found.notes[0].startswith("episode 1")
    together = structs.replace(MAP, trocars="dataset")
    shared = bring(tmp_path, given._replace(lengths=given.lengths[:2]), together, name="shared")
    np.testing.assert_allclose(shared.p_world_trocar, TROCARS[[0, 0], None], atol=1e-4)


def test_two_arms_have_a_trocar_each(tmp_path):
    arms = (ARM, structs.replace(ARM, position="p1", rotation="R1", gripper="jaws1"))
    made = structs.replace(MAP, task="peg_transfer_bimanual", arms=arms)
    with mistakes.of("--map: arms", 1):
        bring(tmp_path, source(arms=2), structs.replace(made, arms=(ARM,)))
    found = bring(tmp_path, source(arms=2), made)
    expected = [TROCARS, TROCARS, TROCARS[::-1]]
    np.testing.assert_allclose(found.p_world_trocar, expected, atol=5e-6)
    assert loaded(tmp_path / "d").observation.pose.p.shape == (360, 2, 3)


def wristed(arrays):
    """Moves the tip by a wrist on the shaft of the ordinary columns, angles in `wrist`."""
    times = arrays["time"]
    angles = np.stack([0.9 * np.sin(1.3 * times), 0.7 * np.cos(0.9 * times)], -1)
    shaft = rcm.Pose(arrays["R0"], arrays["p0"])
    tip = rcm.tip_of(rcm.LARGE_NEEDLE_DRIVER, shaft, angles)
    shaft = {"shaft_R": shaft.R @ TIP_TURN.inv().as_matrix(), "shaft_p": shaft.p}
    return arrays | shaft | {"R0": np.float64(tip.R), "p0": np.float64(tip.p), "wrist": angles}


WRIST_COLUMNS = {
    "angles": ShaftColumns(angles="wrist", instrument="large_needle_driver"),
    "poses": ShaftColumns(position="shaft_p", rotation="shaft_R", turn=wxyz(TIP_TURN)),
}


@pytest.mark.parametrize("way", WRIST_COLUMNS)
@pytest.mark.parametrize("hz", [30.0, 50.0])
def test_the_trocar_of_an_instrument_with_a_wrist_is_that_of_its_shaft(tmp_path, way, hz):
    given = source(change=wristed, hz=hz)
    made = structs.replace(MAP, arms=(structs.replace(ARM, shaft=WRIST_COLUMNS[way]),))
    got = bring(tmp_path, given, made)
    np.testing.assert_allclose(got.p_world_trocar[:, 0], TROCARS[[0, 0, 1]], atol=2e-5)
    assert not got.notes and got.residual_mm.max() < 0.02
    root = tmp_path / "d"
    error = np.load(root / "episodes" / store.keys(root)[0] / "rcm_error.npy")
    assert error.max() < 5e-5  # pose of the shaft
    shaft = np.load(root / "episodes" / store.keys(root)[0] / "shaft_p.npy")[:, 0]
    _, p, _ = moved(np.arange(len(shaft)) / 30, TROCARS[0], 0)
    np.testing.assert_allclose(shaft, p, atol=3e-5)
    assert not [line for line in anomalies.find(root) if "trocar" in line]


def test_the_tip_of_a_wrist_alone_has_no_trocar(tmp_path):
    with mistakes.of("PATH", "wrist"):
        bring(tmp_path, source(change=wristed))


def test_images_are_cut_turned_and_resized(tmp_path):
    given = source(hz=60.0, images=True)
    cameras = {"camera": CameraColumn(column="image", crop=(2, 3, 8, 8), bgr=True)}
    bring(tmp_path, given, structs.replace(MAP, state=(), cameras=cameras))
    drawn = np.asarray(loaded(tmp_path / "d").observation.images["camera"])
    theirs = given.read(0, ["image"])["image"]
    np.testing.assert_array_equal(drawn[:120], theirs[::2, 2:10, 3:11, ::-1])
    small = foreign.pictures(theirs, CameraColumn(column="image", size=6))
    assert small.shape == (240, 6, 6, 3)
    np.testing.assert_allclose(small.mean((1, 2)), theirs.mean((1, 2)), atol=12)
    with mistakes.of("--map: crop", "[12, 16]"):
        foreign.pictures(theirs, CameraColumn(column="image", crop=(8, 0, 8, 8)))
    with mistakes.of("--map: cameras", "wrist"):
        bring(tmp_path, given, structs.replace(MAP, cameras={"wrist": cameras["camera"]}))


def test_failures_are_marked_and_not_learned_from(tmp_path):
    def change(arrays):
        good = arrays["p0"][0, 0] > 0.0
        return arrays | {"good": np.full(len(arrays["time"]), float(good))}

    found = bring(tmp_path, source(change=change), structs.replace(MAP, success="good"))
    good = sum(
        float(moved(np.zeros(1), t, e)[1][0, 0]) > 0 for e, t in enumerate(TROCARS[[0, 0, 1]])
    )
    assert found.episodes == 3 and 0 < good < 3
    assert len(loaded(tmp_path / "d").length) == good


def _nan(arrays):
    arrays["p0"][7, 1] = np.nan
    return arrays


def _quaternions(arrays):
    return arrays | {"R0": 0.5 * transform.Rotation.from_matrix(arrays["R0"]).as_quat()}


def _mirrored(arrays):
    return arrays | {"R0": arrays["R0"] * [1.0, 1.0, -1.0]}


BAD = {
    "nan": (_nan, {}, "column p0", "step 7"),
    "mm": (lambda a: a | {"p0": 1e3 * a["p0"]}, {}, "position", "30"),
    "length": (_quaternions, {"rotation_as": "quat_xyzw"}, "rotation", "0.5"),
    "numbers": (None, {"rotation_as": "quat_xyzw"}, "R0", "9"),
    "mirrored": (_mirrored, {}, "rotation", "mirrored"),
    "sheared": (lambda a: a | {"R0": a["R0"] + 0.3}, {}, "rotation", "off"),
    "tip_turn": (None, {"tip_turn": (2.0, 0.0, 0.0, 0.0)}, "tip_turn", "2.0"),
}


@pytest.mark.parametrize("name", BAD)
def test_columns_that_are_not_what_the_mapping_says(tmp_path, name):
    change, changed, argument, got = BAD[name]
    made = structs.replace(MAP, arms=(structs.replace(ARM, **changed),))
    with mistakes.of(argument, got) as caught:
        bring(tmp_path, source(change=change), made)
    assert "episode 0" in caught.value.got and not (tmp_path / "d").exists()


def test_times_rise(tmp_path):
    times = np.arange(120) / 30
    times[60] = times[59]
    with mistakes.of("time", "step 60"):
        bring(tmp_path, source(times), structs.replace(MAP, time="time"))
    with mistakes.of("--map: hz", "none"):
        bring(tmp_path, source()._replace(hz=0.0))


def test_a_wrong_order_of_quaternions_is_seen(tmp_path):
    """All is well formed, but no shaft passes through one point."""
    given = source(change=written_as("quat_wxyz"))
    made = structs.replace(MAP, arms=(structs.replace(ARM, rotation_as="quat_xyzw"),))
    found = None
    try:
        found = bring(tmp_path, given, made)
    except errors.UsageError as error:
        assert error.argument == "PATH"  # nothing to keep
    assert found is None or any("tip_turn" in note for note in found.notes)


FILES = {
    "toml": ("m.toml", 'task = "reach"\n[[arms]]\nposition = ["x", "y", "z"]\nrotation = "q"\n'),
    "json": ("m.json", json.dumps({"task": "reach", "arms": [{"position": "p", "rotation": "q"}]})),
}


@pytest.mark.parametrize("kind", FILES)
def test_mappings_are_toml_or_json(tmp_path, kind):
    name, text = FILES[kind]
    (tmp_path / name).write_text(text)
    found = mapping.load(tmp_path / name)
    assert found.task == "reach" and found.arms[0].rotation == "q"
    assert found.arms[0].position == (("x", "y", "z") if kind == "toml" else "p")


@pytest.mark.parametrize(
    "text",
    [
        "task = ",
        'taks = "reach"',
        'task = "reach"',
        'task = "reach"\n[[arms]]\nposition = "p"',
        'task = "reach"\n[[arms]]\nposition = "p"\nrotation = "q"\nrotation_as = "quat"',
        'task = "reach"\nturn = [1, 0, 0]\n[[arms]]\nposition = "p"\nrotation = "q"',
        'task = "reach"\n[[arms]]\nposition = "p"\nrotation = "q"\ncommand_position = "p"',
        'task = "reach"\n[[arms]]\nposition = 3\nrotation = "q"',
        'task = "reach"\n[[arms]]\njoints = "p"',
        'task = "reach"\narms = 3',
        'task = "reach"\ncameras = "x"\n[[arms]]\nposition = "p"\nrotation = "q"',
        'task = "reach"\n[cameras.c]\ncolumn="x"\ncrop=[1]\n[[arms]]\nposition="p"\nrotation="q"',
        *(
            'task = "reach"\n[[arms]]\nposition = "p"\nrotation = "q"\n[arms.shaft]\n' + columns
            for columns in ('angles = "w"', 'body = "b"', "", 'position = "p"\nbody = "b"')
        ),
        "\x00",
        "a = " + "[" * 100_000,
    ],
)
def test_a_mapping_that_is_none_is_one_line(tmp_path, text):
    (tmp_path / "m.toml").write_text(text)
    with mistakes.of("--map", "m.toml"):
        mapping.load(tmp_path / "m.toml")


def test_a_mapping_may_begin_with_a_byte_order_mark(tmp_path):
    path = tmp_path / "map.toml"
    text = 'task = "reach"\n[[arms]]\nposition = "p"\nrotation = "q"\n'
    path.write_text(text, "utf-8-sig")
    assert mapping.load(path).task == "reach"


def test_missing_files_and_columns_are_named(tmp_path):
    with mistakes.of("--map", "none.toml"):
        mapping.load(tmp_path / "none.toml")
    with mistakes.of("--map: column", "p7"):
        bring(tmp_path, made=structs.replace(MAP, arms=(structs.replace(ARM, position="p7"),)))
    with mistakes.of("--map: image column", "p0"):
        cameras = {"camera": CameraColumn(column="p0")}
        bring(tmp_path, made=structs.replace(MAP, cameras=cameras))
    with mistakes.of("--map", "neither"):
        bring(tmp_path, made=structs.replace(MAP, state=()))


def test_a_stopped_import_ends_in_the_same_bytes(plain, tmp_path):
    counts = []

    def stop(count):
        counts.append(count)
        if len(counts) == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        foreign.import_mapped(source(), MAP, tmp_path / "d", tmp_path, stop)
    assert len(store.keys(tmp_path / "d")) == 2 and not store.is_sealed(tmp_path / "d")
    bring(tmp_path)
    assert kill.tree(tmp_path / "d") == kill.tree(plain[1])


MAPPING = {
    "lerobot": ("observation.state", "action", "observation.environment_state"),
    "robomimic": ("obs/state", "actions", "obs/environment_state"),
    "zarr": ("state", "action", "environment_state"),
}


@pytest.mark.parametrize("name", MAPPING)
def test_an_export_without_its_trocars_comes_back_with_them(tmp_path, name):
    """The whole way: our demonstrations as a stranger would have them."""
    recorded.write(tmp_path / "ours")
    form = base.FORMATS.get(name)
    out = tmp_path / ("out.hdf5" if name == "robomimic" else "out")
    ours = exchange.source(tmp_path / "ours", form)
    kept = {
        column: about
        for column, about in ours.columns.items()
        if "starjax" not in column and "trocar" not in column
    }
    exchange.export(ours._replace(columns=kept, origin=None), out, form)
    state, action, task = MAPPING[name]
    arm = ArmColumns(
        position=f"{state}[0:3]",
        rotation=f"{state}[3:7]",
        gripper=f"{state}[7]",
        command_position=f"{action}[0:3]",
        command_rotation=f"{action}[3:7]",
        command_gripper=f"{action}[7]",
    )
    made = Map(task="peg_transfer", state=task, arms=(arm,), hz=30.0)
    with base.open_dataset(out, name) as given:
        assert given.origin is None and set(given.columns) >= set(kept)
        found = bring(tmp_path, given, made)
    before, after = loaded(tmp_path / "ours"), loaded(tmp_path / "d")
    offset = after.trocar.p_world_trocar - before.trocar.p_world_trocar
    assert np.linalg.norm(offset, axis=-1).max() < 5e-4 and not found.notes
    np.testing.assert_allclose(after.command.pose.R, before.command.pose.R, atol=1e-6)
    np.testing.assert_array_equal(after.command.pose.p, before.command.pose.p)
    np.testing.assert_array_equal(after.observation.state, before.observation.state)
    shutil.rmtree(tmp_path / "d")
