"""The contract of time, names and units holds for every format, as the page's table says."""

import os
import pathlib
import re
import shutil
import sys

import h5py
import mistakes
import numpy as np
import pytest
import several_formats as several
from msgspec import structs
from scipy.spatial import transform
from several_formats import BAGS, ROWS, recording
from strangers import ARM, MAP, bring
from strangers import source as strangers_source

from starjax.addons.formats import base, clocks, file_states, foreign, labels, ranges, timing
from starjax.addons.formats.base import Column
from starjax.addons.formats.mapping import ArmColumns, CameraColumn
from starjax.data import load

PAGE = pathlib.Path(__file__).parents[3] / "docs/use/other-peoples-data.md"


def opened(path):
    return base.open_dataset(path, base.detect(path))


def inspected(source):
    return timing.anomalies(source, 0, source.read(0, clocks.columns(source)))


@pytest.mark.parametrize("name", [*ROWS, *BAGS])
def test_a_sound_recording_has_no_note(tmp_path, name):
    path = several.write(name, tmp_path / "theirs", [recording(0), recording(1)])
    with opened(path) as source:
        assert not inspected(source)
        found = foreign.import_mapped(source, several.mapping(name), tmp_path / "d", path)
    assert found.episodes == found.successes == 2 and not found.notes


def rate(name):
    """Times of 100 Hz with a rate of 30 Hz."""
    made = several.mapping(name, time=(), hz=30.0)
    return recording(hz=100.0), made, "100 Hz", name not in ("csv", "aloha", "rosbag")


def stalled(name):
    """The jaws' stream ends after 1 s."""
    if name in BAGS:
        shown = recording().columns
        few = shown["time"] < 1.0
        return recording(jaw=shown["jaw"][few], jaw_time=shown["time"][few]), None, "old", True
    return recording(jaw_time=np.minimum(recording().columns["time"], 1.0)), None, "old", True


def skewed(name):
    """The jaws' clock is 0.4 s behind the tool's."""
    times = recording().columns["time"]
    made = recording(jaw_time=times - 0.4)
    return made._replace(logged={"tip": times, "jaw": times}), None, "0.40 s", True


def milliseconds(name):
    """Times are in ms."""
    return recording(time=1e3 * recording().columns["time"]), None, "in ms?", False


def gap(name):
    """No row for 1 s."""
    whole = recording().columns
    rows = (whole["time"] < 1.0) | (whole["time"] > 2.0)
    made = several.mapping(name, time=(), hz=30.0)
    return recording(**{n: x[rows] for n, x in whole.items()}), made, "gap of 1.0", True


def drifting(name):
    """The jaws' clock runs 10% slow."""
    times = recording().columns["time"]
    made = recording(jaw_time=0.9 * times)
    return made._replace(logged={"tip": times, "jaw": times}), None, "jaw", True


# Row of the page's table -> its case, and the formats whose files may have it.
CASES = {
    "rate, times": (rate, [*ROWS, *BAGS]),
    "streams that end": (stalled, [*ROWS, *BAGS]),
    "clocks apart": (skewed, [*ROWS, *BAGS]),
    "clocks that drift": (drifting, [*ROWS, *BAGS]),
    "times in ms": (milliseconds, ROWS),
    "gaps": (gap, [*ROWS, *BAGS]),
}


@pytest.mark.parametrize(
    ("row", "name"), [(row, name) for row, (_, names) in CASES.items() for name in names]
)
def test_times_that_contradict_are_noted_or_left_out(tmp_path, row, name):
    made, columns, word, is_inspected = CASES[row][0](name)
    path = several.write(name, tmp_path / "theirs", [made, recording(1)], several.HZ)
    with opened(path) as source:
        assert not is_inspected or any(word in line for line in inspected(source))
        found = foreign.import_mapped(
            source, columns or several.mapping(name), tmp_path / "d", path
        )
    assert any(word in line and "episode 0" in line for line in found.notes), found.notes
    assert not any("episode 1" in line for line in found.notes) or columns, found.notes


# Other data of one file or folder each: row of the page's table -> mapping, columns, word.
def entries(order, labels):
    """The strangers' arm with a quaternion in a column of names."""
    arm = structs.replace(ARM, rotation="q", rotation_as=order)
    column = Column((4,), "float64", labels)
    given = strangers_source(change=lambda a: a | {"q": quaternions(a, order)})
    return given._replace(columns=given.columns | {"q": column}), structs.replace(MAP, arms=(arm,))


def quaternions(arrays, order):
    xyzw = transform.Rotation.from_matrix(arrays["R0"]).as_quat()
    return xyzw if order == "quat_xyzw" else np.roll(xyzw, 1, -1)


@pytest.mark.parametrize("labels", [("qw", "qx", "qy", "qz"), ("rot_w", "rot_x", "rot_y", "rot_z")])
def test_names_of_another_order_are_noted(tmp_path, labels):
    given, made = entries("quat_xyzw", labels)
    assert any("qw" in x or "rot_w" in x for x in bring(tmp_path, given, made).notes)
    given, made = entries("quat_wxyz", labels)
    assert not bring(tmp_path, given, made, "e").notes


@pytest.mark.parametrize(("name", "is_odd"), [("p_mm", True), ("p_m", False), ("tip", False)])
def test_names_of_another_unit_are_noted(tmp_path, name, is_odd):
    given = strangers_source(change=lambda a: a | {name: a["p0"]})
    made = structs.replace(MAP, arms=(structs.replace(ARM, position=name),))
    assert any("read in m" in x for x in bring(tmp_path, given, made).notes) == is_odd


ARM_MODEL = """<mujoco><worldbody><body name="base" pos="0.02 -0.01 0.16"><geom size=".001"/>
<body><joint name="yaw" axis="1 0 0" range="-90 90"/><geom size=".001"/>
<body><joint name="pitch" axis="0 1 0" range="-90 90"/><geom size=".001"/>
<body euler="180 0 0"><joint name="insertion" type="slide" axis="0 0 1" range="0 0.24"/>
<geom size=".001"/><body name="tool"><joint name="roll" axis="0 0 1"/><geom size=".001"/>
</body></body></body></body></body></worldbody></mujoco>"""
JOINTS = ("yaw", "pitch", "insertion", "roll")


def joints(times):
    """Joints of the model by name."""
    return {
        "yaw": 0.25 * np.sin(0.9 * times),
        "pitch": 0.2 * np.cos(1.1 * times),
        "insertion": 0.11 + 0.02 * np.sin(0.7 * times),
        "roll": 0.3 * np.sin(0.5 * times),
    }


def robot(tmp_path, columns, names=(), order=()):
    """Source of a column `q` with names, and its mapping."""
    (tmp_path / "arm.xml").write_text(ARM_MODEL)
    given = strangers_source(change=lambda a: a | {"q": columns(joints(a["time"]))})
    given = given._replace(columns=given.columns | {"q": Column((4,), "float64", tuple(names))})
    arm = ArmColumns(joints="q", model="arm.xml", joint_names=order, body="tool", gripper="jaws0")
    return given, structs.replace(MAP, arms=(arm,))


@pytest.mark.parametrize("order", [JOINTS, ()])
@pytest.mark.parametrize("called", ["{}", "{}.pos", "left_{}"])
def test_joints_are_taken_by_their_names(tmp_path, order, called):
    plain = robot(tmp_path, lambda q: np.stack([q[n] for n in JOINTS], -1), JOINTS, JOINTS)
    bring(tmp_path, *plain, "plain")
    mixed = sorted(JOINTS)
    names = [called.format(name) for name in mixed]
    other = robot(tmp_path, lambda q: np.stack([q[n] for n in mixed], -1), names, order)
    bring(tmp_path, *other, "mixed")
    np.testing.assert_array_equal(tips(tmp_path / "mixed"), tips(tmp_path / "plain"))


def test_a_joint_that_no_column_is_called_is_refused(tmp_path):
    names = ("yaw", "pitch", "roll", "wrist")
    given, made = robot(tmp_path, lambda q: np.zeros((len(q["yaw"]), 4)), names, JOINTS)
    with mistakes.of("--map: joints", "insertion"):
        bring(tmp_path, given, made)


def test_an_entry_may_be_named(tmp_path):
    given, _ = robot(tmp_path, lambda q: np.stack([q[n] for n in sorted(JOINTS)], -1), JOINTS)
    made = structs.replace(MAP, arms=(structs.replace(ARM, gripper="q[pitch]"),))
    assert labels.resolve(made, given, tmp_path).arms[0].gripper == ("q[1]",)
    made = structs.replace(MAP, arms=(structs.replace(ARM, gripper="q[elbow]"),))
    with mistakes.of("--map: entry of q", "elbow"):
        labels.resolve(made, given, tmp_path)


@pytest.mark.parametrize(
    ("joint", "scale", "words"),
    [(0, 180 / np.pi, "degrees"), (2, 1e3, "mm"), (3, 1800 / np.pi, "roll"), (2, 3.0, "insertion")],
)
def test_joints_beyond_their_limits_are_noted_with_the_likely_unit(tmp_path, joint, scale, words):
    wide = np.where(np.arange(4) == joint, scale, 1.0)
    given, made = robot(
        tmp_path, lambda q: wide * np.stack([q[n] for n in JOINTS], -1), JOINTS, JOINTS
    )
    found = ranges.Joints(made.arms, tmp_path)
    found.add(given.read(0, ["q"]))
    (line,) = found.notes()
    assert words in line and JOINTS[joint] in line


def tips(root):
    (path, *_) = sorted((root / "episodes").iterdir())
    return np.load(path / "p.npy")


@pytest.mark.parametrize("k", [0, 1])
@pytest.mark.parametrize("name", ["csv", "aloha", "lerobot-v2.1", "rosbag", "robomimic"])
def test_a_file_that_cannot_be_read_is_an_episode_left_out(tmp_path, name, k):
    path = several.write(name, tmp_path / "theirs", [recording(i) for i in range(3)])
    if name == "robomimic":
        with h5py.File(path, "a") as file:
            del file[f"data/demo_{k}"]
            file[f"data/demo_{k}"] = 0.0
        bad = f"demo_{k}"
    elif name == "lerobot-v2.1":
        (victim,) = path.rglob(f"episode_00000{k}.parquet")
        victim.write_bytes(victim.read_bytes()[:200])
        bad = f"episode {k}"
    else:
        (victim,) = (x for x in path.rglob(f"episode_{k}*") if x.is_file())
        victim.write_bytes(victim.read_bytes()[:-30])
        bad = f"episode_{k}"
    with opened(path) as source:
        found = foreign.import_mapped(source, several.mapping(name), tmp_path / "d", path)
        assert (found.episodes, found.left_out) == (2, 1)
        (line,) = found.notes
        assert bad in line and "\n" not in line
        made = several.mapping(name, skip=(k,))
        assert not foreign.import_mapped(source, made, tmp_path / "e", path).notes


@pytest.mark.parametrize("name", ["csv", "aloha", "rosbag", "jigsaws", "lerobot", "zarr"])
def test_hidden_files_are_skipped(tmp_path, name):
    path = tmp_path / "theirs"
    if name == "jigsaws":
        path.mkdir()
        np.savetxt(path / "Suturing_B001.txt", np.random.default_rng(0).normal(size=(9, 76)))
    else:
        path = several.write(name, path, [recording()])
    for file in [x for x in path.rglob("*") if x.is_file()]:
        file.with_name(f"._{file.name}").write_bytes(b"\x00\x05\x16\x07Mac OS X")
    assert base.detect(path) == name
    with opened(path) as source:
        assert len(source.lengths) == 1 and not source.faults


@pytest.mark.parametrize("folder", ["a#1", "is it?", "100%25", "plain"])
def test_odd_characters_in_the_path_of_a_bag(tmp_path, folder):
    several.bag(tmp_path / "written", TOPICS, "SQLITE3")
    (tmp_path / folder).mkdir()
    (database,) = (tmp_path / "written").glob("*.db3")
    shutil.copy(database, tmp_path / folder / f"{folder}.db3")
    shutil.copytree(tmp_path / "written", tmp_path / folder / "bag")
    # A file that the path's beginning names is not read in its place.
    for path in (tmp_path / folder / f"{folder}.db3", tmp_path / folder / "bag"):
        with opened(path) as source:
            assert source.read(0, ["jaw"])["jaw"].shape == (5, 2)


POSE = np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0])
TOPICS = {
    "tip": [(0.1 * i, 0.1 * i, POSE) for i in range(5)],
    "jaw": [(0.1 * i, 0.1 * i, {"a": i, "b": -i}) for i in range(5)],
}


def test_joints_of_messages_are_taken_by_their_names(tmp_path):
    mixed = [
        (t, log, dict(reversed(value.items())) if i % 2 else value)
        for i, (t, log, value) in enumerate(TOPICS["jaw"])
    ]
    several.bag(tmp_path / "mixed", TOPICS | {"jaw": mixed})
    with opened(tmp_path / "mixed") as source:
        assert source.columns["jaw"].names == ("a", "b")
        np.testing.assert_array_equal(source.read(0, ["jaw"])["jaw"][:, 1], -np.arange(5.0))
    for i, other in enumerate(({"a": 1.0}, {"a": 1.0, "c": 2.0})):
        lacking = [*TOPICS["jaw"][:4], (0.4, 0.4, other)]
        several.bag(tmp_path / f"lacking{i}", TOPICS | {"jaw": lacking})
        path = tmp_path / f"lacking{i}"
        with opened(path) as source, mistakes.of(f"{path}, episode 0", "joints a, b"):
            source.read(0, ["jaw"])


def test_the_first_stream_of_the_mapping_is_the_clock(tmp_path):
    slow = [(0.45 * i, 0.45 * i, POSE) for i in range(4)]
    fast = [(0.01 * i, 0.01 * i, POSE + 0.01 * i) for i in range(100)]
    several.bag(tmp_path / "bag", {"a": slow, "b": fast})
    with opened(tmp_path / "bag") as source:
        assert list(source.lengths) == [100]  # the faster one without a mapping
        joined = source.by(["a", "b"])
        assert list(joined.lengths) == [4]
        found = joined.timing(0)
        np.testing.assert_allclose(found.ages["b"], [0.0, 0.0, 0.0, 0.36], atol=1e-6)
        assert "100 messages" in found.notes[0]
        assert not source.by(["b", "a"]).timing(0).notes


def test_steps_before_a_streams_first_value_are_left_out():
    times = np.arange(90) / 30
    late = timing.Stream(times[30:], times[30:])
    found, rows = timing.join({"tip": timing.Stream(times, times), "jaw": late}, "tip")
    first, notes = timing.usable(found, ["tip", "jaw"], 0.5)
    assert first == 30 and "late" in notes[0] and rows["jaw"][29] == -1
    with pytest.raises(timing.Gap):  # clocks that do not overlap
        apart = timing.Stream(times + 10, times + 10)
        found, _ = timing.join({"tip": timing.Stream(times, times), "jaw": apart}, "tip")
        timing.usable(found, ["jaw"], 0.5)


@pytest.mark.parametrize("period", [0.05, 0.45])
def test_slow_clocks_and_held_values_are_noted(tmp_path, period):
    plain = strangers_source().read(0, ["time", "p0", "R0", "jaws0", "state"])
    held = np.searchsorted(plain["time"], period * (plain["time"] // period) - 1e-9)

    def hold(arrays):
        return arrays | {name: arrays[name][held] for name in ("p0", "R0")}

    def hold_images(arrays):
        frames = np.zeros((len(held), 12, 16, 3), np.uint8) + held[:, None, None, None]
        return arrays | {"image": frames.astype(np.uint8)}

    slow = np.unique(held)
    cameras = {"camera": CameraColumn(column="image")}
    timed = structs.replace(MAP, time="time")
    cases = {
        "pose": (strangers_source(change=hold), MAP),
        "image": (
            strangers_source(change=hold_images, images=True), structs.replace(MAP, cameras=cameras)
        ),
        "apart": (strangers_source(change=lambda a: {n: x[slow] for n, x in a.items()}), timed),
    }  # fmt: skip
    for word, (given, made) in cases.items():
        given = given._replace(hz=0.0 if made.time else given.hz)
        notes = bring(tmp_path, given, made, word).notes
        assert any(word in line for line in notes) == (period > 0.1), notes


@pytest.mark.parametrize("what", ["image", "pose", "two arms"])
def test_streams_that_leave_their_last_value_are_noted(tmp_path, what):
    def change(arrays):
        rows = np.minimum(np.arange(len(arrays["time"])), 40)
        if what == "image":
            ramp = np.arange(len(rows), dtype=np.uint8)[:, None, None, None]
            return arrays | {"image": (arrays["image"] * 0 + ramp)[rows]}
        stopped = {name: arrays[name][rows] for name in ("p0", "R0")}
        return arrays | stopped | {"cp": arrays["p0"], "cR": arrays["R0"]}

    arms = 2 if what == "two arms" else 1
    given = strangers_source(change=change, images=what == "image", arms=arms)
    arm, second = ARM, structs.replace(ARM, position="p1", rotation="R1", gripper="jaws1")
    if what == "pose":
        arm = structs.replace(ARM, command_position="cp", command_rotation="cR")
    cameras = {"camera": CameraColumn(column="image")} if what == "image" else {}
    made = structs.replace(MAP, arms=(arm, second)[:arms], cameras=cameras)
    made = structs.replace(made, task="peg_transfer_bimanual") if arms == 2 else made
    assert any("repeats for 2.6" in x for x in bring(tmp_path, given, made).notes)


def test_an_import_goes_on_with_the_same_files_only(tmp_path, monkeypatch):
    path = several.write("csv", tmp_path / "theirs", [recording(i) for i in range(2)])
    made = several.mapping("csv")

    def stop(count):
        stop.left -= 1
        if stop.left < 0:
            raise KeyboardInterrupt

    before = (path / "episode_0.csv").stat()
    for change in (False, True):
        out, stop.left = tmp_path / f"d{change}", 3  # two readings, one episode
        with opened(path) as source, pytest.raises(KeyboardInterrupt):
            foreign.import_mapped(source, made, out, path, stop)
        if change:
            file = path / "episode_0.csv"
            file.write_text(file.read_text().replace("1", "2", 1))
            os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))  # as a copy may keep them
        with opened(path) as source:
            if change:
                with mistakes.of("OUT", "episode_0.csv"):
                    foreign.import_mapped(source, made, out, path)
            else:
                assert foreign.import_mapped(source, made, out, path).episodes == 2


def test_a_change_inside_a_table_of_a_megabyte_is_seen(tmp_path):
    path = tmp_path / "table"
    path.write_bytes(bytes(1_000_000))
    before, state = path.stat(), file_states.of(path)
    path.write_bytes(bytes(500_000) + b"1" + bytes(499_999))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert file_states.of(path) != state


@pytest.mark.parametrize("name", ["elapsed_ms", "t_ns", "time_us", "Time (s)", "t"])
def test_times_are_known_by_their_names(name):
    assert name in clocks.named({name: Column((), "float64")}) and not clocks.own_words(name)


def test_dates_in_csv_are_times(tmp_path):
    text = "\n".join(f"2026-11-28 10:00:{i / 50:09.6f},{i}" for i in range(100))
    (tmp_path / "a.csv").write_text(f"stamp,x\n{text}\n")
    with opened(tmp_path / "a.csv") as source:
        times = source.read(0, ["stamp"])["stamp"]
        np.testing.assert_allclose(np.diff(times), 0.02, atol=1e-6)


@pytest.mark.parametrize("by", [",", ";", "\t", "|", ", "])
def test_delimiters_of_csv(tmp_path, by):
    rows = [("x", "y"), ("0.5", "1.5"), ("2", "3")]
    (tmp_path / "a.csv").write_text("\n".join(by.join(row) for row in rows))
    with opened(tmp_path / "a.csv") as source:
        np.testing.assert_array_equal(source.read(0, ["y"])["y"], [1.5, 3.0])


def test_a_file_without_delimiters_is_refused_by_its_first_line(tmp_path):
    (tmp_path / "a.csv").write_text("# of a lab\nx,y\n1,2\n")
    with mistakes.of(str(tmp_path / "a.csv"), "of a lab"), opened(tmp_path / "a.csv"):
        pass


def test_a_link_that_leads_nowhere_is_one_line(tmp_path):
    (tmp_path / "a.csv").symlink_to("/nowhere/a.csv")
    with mistakes.of(str(tmp_path), "/nowhere/a.csv"):
        base.detect(tmp_path)


def test_a_refused_dataset_comes_with_doubts_on_its_names(tmp_path):
    given, made = entries("quat_wxyz", ("qw", "qx", "qy", "qz"))
    arm = structs.replace(made.arms[0], rotation_as="quat_xyzw")
    with mistakes.of("PATH", "trocar") as caught:
        bring(tmp_path, given, structs.replace(made, arms=(arm,)))
    assert "qw, qx" in caught.value.hint


def test_no_success_is_noted(tmp_path):
    given = strangers_source(change=lambda a: a | {"reward": np.minimum(a["time"] - 4.0, 0.0)})
    made = structs.replace(MAP, success="reward")
    found = bring(tmp_path, given, made)
    assert found.successes == 0 and any("reward ends at -0.0" in x for x in found.notes)
    with mistakes.of("root", "none"):
        load.load(tmp_path / "d", residency="host")


@pytest.mark.skipif(sys.platform == "win32", reason="no flock")
@pytest.mark.parametrize("name", ["aloha", "robomimic"])
def test_hdf5_is_read_where_it_cannot_be_locked(tmp_path, name):
    import fcntl

    path = several.write(name, tmp_path / "theirs", [recording()])
    (file,) = tmp_path.rglob("*.hdf5")
    with open(file) as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with opened(path) as source:
            assert source.read(0, ["p"])["p"].shape == (90, 3)


def test_the_pages_table_has_a_row_for_each_check():
    table = PAGE.read_text().partition("| Times, names, units |")[2].partition("\n\n")[0]
    rows = re.findall(r"^\| (.+?) \| ", table, re.MULTILINE)
    assert set(CASES) <= set(rows)
