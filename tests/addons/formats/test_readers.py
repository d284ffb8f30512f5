"""Readers of peers' files: the written values are read, and a bag of CRTK topics is imported."""

import io
import shutil

import h5py
import mistakes
import numpy as np
import openh
import pytest
from msgspec import structs
from PIL import Image
from scipy.spatial import transform

from starjax.addons.formats import base, foreign, mapping, ready

RNG = np.random.default_rng(0)


def opened(path, name):
    assert base.detect(path) == name
    return base.open_dataset(path, name)


def jpeg(image):
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "JPEG")
    return np.frombuffer(buffer.getvalue(), np.uint8)


@pytest.mark.parametrize("packed", [False, True])
def test_aloha(tmp_path, packed):
    lengths, images, actions = (9, 7, 8), [], []
    for i, length in enumerate(lengths):
        actions.append(RNG.normal(size=(length, 14)).astype(np.float32))
        shade = np.linspace(20, 200, length * 16 * 16 * 3).reshape(length, 16, 16, 3)
        images.append(shade.astype(np.uint8))
        with h5py.File(tmp_path / f"episode_{(0, 2, 10)[i]}.hdf5", "w") as file:
            file["action"], file["observations/qpos"] = actions[i], actions[i] + 1
            shown = images[i]
            if packed:
                files = [jpeg(image) for image in shown]
                widest = max(map(len, files))
                shown = np.stack([np.pad(x, (0, widest - len(x))) for x in files])
            file["observations/images/cam_high"] = shown
    with opened(tmp_path, "aloha") as source:
        assert list(source.lengths) == list(lengths) and source.hz == 0.0
        assert source.columns["observations/images/cam_high"].is_image
        found = source.read(2, ["action", "observations/qpos", "observations/images/cam_high"])
    np.testing.assert_array_equal(found["action"], actions[2])  # 10 follows 2
    np.testing.assert_array_equal(found["observations/qpos"], actions[2] + 1)
    offset = found["observations/images/cam_high"].astype(int) - images[2]
    assert np.abs(offset).max() <= (6 if packed else 0)


def test_jigsaws(tmp_path):
    folder = tmp_path / "Suturing" / "kinematics" / "AllGestures"
    folder.mkdir(parents=True)
    rows = [RNG.normal(size=(length, 76)) for length in (12, 15)]
    for i, table in enumerate(rows):
        np.savetxt(folder / f"Suturing_B00{i + 1}.txt", table, fmt="%.6f")
    with opened(tmp_path / "Suturing", "jigsaws") as source:
        assert source.hz == 30.0 and list(source.lengths) == [12, 15]
        assert ready.choose(source) == "jigsaws"
        found = source.read(1, ["slave_right", "master_left"])
    np.testing.assert_allclose(found["slave_right"], rows[1][:, 57:], atol=1e-6)
    np.testing.assert_allclose(found["master_left"], rows[1][:, :19], atol=1e-6)


def table(rows, name="x"):
    lines = [f"{name},label,episode", *(f"{x},word,{i}" for x, i in rows)]
    return "\n".join(lines) + "\n"


def test_csv(tmp_path):
    one = tmp_path / "all.csv"
    one.write_text(table([(0.5, 3), (1.5, 3), (2.5, 4)]))
    with opened(one, "csv") as source:
        assert list(source.lengths) == [2, 1] and list(source.columns) == ["x"]
        np.testing.assert_array_equal(source.read(0, ["x"])["x"], [0.5, 1.5])
        np.testing.assert_array_equal(source.read(1, ["x"])["x"], [2.5])
    folder = tmp_path / "folder"
    folder.mkdir()
    for i in (2, 10):
        (folder / f"run{i}.csv").write_text(table([(i, 0)] * i))
    with opened(folder, "csv") as source:
        assert list(source.lengths) == [2, 10]
    (folder / "run11.csv").write_text(table([(1.0, 0)], "y"))
    with opened(folder, "csv") as source, mistakes.of(f"{folder}, episode 2", "run11"):
        source.read(2, ["x"])
    again = tmp_path / "again.csv"
    again.write_text(table([(0.5, 3), (1.5, 4), (2.5, 3)]))
    with mistakes.of(str(again), "twice"), opened(again, "csv"):
        pass


def test_zipped_zarr(tmp_path):
    made = openh.source("tud-ur5e", episodes=2)
    base.FORMATS.get("zarr").write(tmp_path / "plain", made, False)
    shutil.make_archive(str(tmp_path / "out.zarr"), "zip", tmp_path / "plain")
    with opened(tmp_path / "out.zarr.zip", "zarr") as source:
        assert source.hz == 30.0 and list(source.lengths) == [openh.STEPS] * 2
        found = source.read(1, source.columns)
    for name, array in made.read(1, made.columns).items():
        np.testing.assert_array_equal(found[name], array)


def test_a_column_of_an_unknown_codec_is_omitted(tmp_path):
    made = openh.source("tud-ur5e", episodes=2)
    base.FORMATS.get("zarr").write(tmp_path / "d", made, False)
    header = tmp_path / "d/data/action/.zarray"
    header.write_text(header.read_text().replace('"blosc"', '"imagecodecs_jpegxl"'))
    with opened(tmp_path / "d", "zarr") as source:
        assert "action" not in source.columns and "jpegxl" in source.notes[0]
        source.read(0, source.columns)


TOPICS = ("PSM1/local/measured_cp", "PSM1/measured_js", "PSM1/jaw/measured_js")


IMAGES = "endoscope/left/image_raw/compressed"
KINDS = (
    "geometry_msgs/msg/PoseStamped",
    *["sensor_msgs/msg/JointState"] * 2,
    "sensor_msgs/msg/CompressedImage",
)
SHADE = np.full((12, 16, 3), 90, np.uint8)


def write_bag(path, episode, storage):
    """A dVRK arm's topics: poses at 30 Hz in its base frame, joints at other times."""
    writer = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types

    def header(t):
        stamp = types["builtin_interfaces/msg/Time"](sec=int(t), nanosec=int(t % 1 * 1e9))
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id="PSM1_base")

    def joints(t, position):
        make = types["sensor_msgs/msg/JointState"]
        empty = np.zeros(0)
        return make(header(t), [], np.asarray(position, np.float64), empty, empty)

    p, R, jaw, q = openh.arm(episode, True, np.zeros(3))
    xyzw = R.as_quat()
    with writer.Writer(path, version=9, storage_plugin=storage) as bag:
        to = [
            bag.add_connection(f"/{topic}", kind, typestore=store)
            for topic, kind in zip((*TOPICS, IMAGES), KINDS)
        ]
        for i in range(openh.STEPS):
            t = 100.0 + i / openh.HZ
            point = types["geometry_msgs/msg/Point"](*map(float, p[i]))
            turn = types["geometry_msgs/msg/Quaternion"](*map(float, xyzw[i]))
            pose = types["geometry_msgs/msg/Pose"](point, turn)
            stamped = types["geometry_msgs/msg/PoseStamped"](header(t), pose)
            image = types["sensor_msgs/msg/CompressedImage"](header(t), "jpeg", jpeg(SHADE + i))
            messages = (image, joints(t - 1e-3, q[i]), joints(t - 1e-3, jaw[i]), stamped)
            for connection, message in zip((to[3], to[1], to[2], to[0]), messages):
                data = store.serialize_cdr(message, connection.msgtype)
                bag.write(connection, int(1e9 * t), data)


@pytest.mark.parametrize("storage", ["MCAP", "SQLITE3"])
def test_bags_of_crtk_topics_are_imported(tmp_path, storage):
    plugin = getattr(pytest.importorskip("rosbags.rosbag2").StoragePlugin, storage)
    folder = tmp_path / "bags"
    folder.mkdir()
    for episode in range(2):
        write_bag(folder / f"run{episode}", episode, plugin)
    with opened(folder, "rosbag") as source:
        assert list(source.lengths) == [openh.STEPS] * 2
        arrays = source.read(1, [*TOPICS, "time"])
        p, R, jaw, q = openh.arm(1, True, np.zeros(3))
        np.testing.assert_allclose(arrays["PSM1/local/measured_cp"][:, :3], p, atol=1e-12)
        turned = transform.Rotation.from_quat(arrays["PSM1/local/measured_cp"][:, 3:])
        assert (turned * R.inv()).magnitude().max() < 1e-9
        np.testing.assert_array_equal(arrays["PSM1/measured_js"], q)
        np.testing.assert_array_equal(arrays["PSM1/jaw/measured_js"], jaw)
        np.testing.assert_allclose(np.diff(arrays["time"]), 1 / openh.HZ, atol=1e-6)
        assert ready.choose(source) == "dvrk"
        cameras = {"camera": mapping.CameraColumn(column=IMAGES)}
        columns = structs.replace(mapping.load(ready.find("dvrk")), cameras=cameras)
        found = foreign.import_mapped(source, columns, tmp_path / "d", ready.FOLDER)
    assert found.episodes == 2 and found.residual_mm.max() < 0.05 and not found.notes


def test_another_release_of_a_format_is_not_taken_for_it(tmp_path):
    for name in ("notes.txt", "x.json"):
        (tmp_path / name).write_text("hello\n")
        with mistakes.of("PATH", name):
            base.detect(tmp_path / name)
