"""Bad files of other formats: each is one line that names it; none leads out of its folder."""

import json
import os
import shutil

import fuzz_formats
import h5py
import mistakes
import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest
import zarr

from starjax.addons.formats import base, lerobot
from starjax.core import errors
from starjax.runtime import xla

NAMES = base.writable()


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """Format -> a small export with images, by video if the format has it."""
    return {
        name: fuzz_formats.prepared(tmp_path_factory.mktemp(name), name, whole=True)
        for name in NAMES
    }


@pytest.fixture
def copy(sound, tmp_path):
    def make(name):
        target = tmp_path / sound[name].name
        (shutil.copytree if sound[name].is_dir() else shutil.copy)(sound[name], target)
        return target

    return make


def refused(path, name):
    """The error of reading a whole file."""
    with pytest.raises(errors.UsageError) as caught, base.open_dataset(path, name) as source:
        for episode in range(len(source.lengths)):
            source.read(episode, source.columns)
    assert str(path) in caught.value.argument and "\n" not in str(caught.value)
    return str(caught.value.got)


def info(path, **changed):
    file = path / "meta/info.json"
    about = json.loads(file.read_text())
    file.write_text(json.dumps(about | changed))
    return about


def feature(path, name, **changed):
    features = info(path)["features"]
    features[name] |= changed
    info(path, features=features)


def rewritten(path, name, column):
    """A table with one column of other cells."""
    table = parquet.read_table(path)
    at = table.column_names.index(name)
    parquet.write_table(table.set_column(at, name, column(table[name])), path)


DATA, EPISODES = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"
VIDEO = "videos/observation.images.camera/chunk-000/file-000.mp4"
LEROBOT = {
    "truncated": lambda d: os.truncate(d / DATA, 3000),
    "empty": lambda d: os.truncate(d / DATA, 0),
    "no table": lambda d: (d / DATA).unlink(),
    "no video": lambda d: (d / VIDEO).unlink(),
    "cut video": lambda d: os.truncate(d / VIDEO, 900),
    "no video in it": lambda d: (d / VIDEO).write_bytes(b"x" * 5000),
    "no episodes": lambda d: shutil.rmtree(d / "meta/episodes"),
    "future": lambda d: info(d, codebase_version="v4.0"),
    "no fps": lambda d: info(d, fps=0),
    "other rate": lambda d: info(d, fps=17),
    "shape": lambda d: feature(d, "action", shape=[7]),
    "size": lambda d: feature(d, "observation.images.camera", shape=[16, 16, 3]),
    "huge": lambda d: feature(d, "observation.images.camera", shape=[10**7, 10**7, 3]),
    "kind": lambda d: feature(d, "action", dtype="int8"),
    "length": lambda d: rewritten(d / EPISODES, "length", lambda c: pa.array([5, 6])),
    "escape": lambda d: rewritten(
        d / EPISODES, "data/chunk_index", lambda c: pa.array(["../../x", "../../x"])
    ),
    "nothing": lambda d: rewritten(d / DATA, "next.reward", lambda c: pa.nulls(len(c))),
    "link": lambda d: ((d / DATA).rename(d.parent / "x"), (d / DATA).symlink_to(d.parent / "x")),
}


@pytest.mark.parametrize("kind", LEROBOT)
def test_bad_lerobot_folders(copy, kind):
    path = copy("lerobot")
    LEROBOT[kind](path)
    assert refused(path, "lerobot")


def test_a_feature_that_is_a_path_is_refused(copy, tmp_path):
    path = copy("lerobot")
    features = info(path)["features"]
    features["../../../x"] = features["observation.images.camera"]
    info(path, features=features)
    assert "../../../x" in refused(path, "lerobot")


def _edit(path, change):
    with h5py.File(path, "r+") as file:
        change(file)


def _external(file):
    file["data/demo_0/obs/out"] = h5py.ExternalLink("/etc/passwd", "/x")


def _elsewhere(file):
    file["data/demo_0"].create_dataset("raw", (6, 1), "f4", external=[("/etc/passwd", 0, 24)])


def _virtual(file):
    layout = h5py.VirtualLayout((6, 1), "f4")
    layout[:] = h5py.VirtualSource("/etc/passwd", "x", (6, 1))
    file["data/demo_0"].create_virtual_dataset("raw", layout)


def _circle(file):
    file["data/demo_0/again"] = file["data/demo_0"]


def _names(file):
    """A group with two names: sixty a group, six deep, are more paths than can be walked."""
    inside = file["data/demo_0"].create_group("n")
    file["data/demo_0/again"] = inside


def _together(file):
    demo, each = file["data/demo_0"], int(base.MEMORY_SHARE * xla.memory_bytes() / 6 * 0.6)
    demo.create_dataset("some", (6, each), "u1", chunks=(1, 1000))
    demo.create_dataset("more", (6, each), "u1", chunks=(1, 1000))


def _rate(file):
    del file["starjax"]
    file["data"].attrs["env_args"] = np.bytes_('{"control_freq": -1e999}')


def _huge(file):
    file["data/demo_0"].create_dataset("raw", (6, 10**10), "f4", chunks=(1, 1000))


def _short(file):
    del file["data/demo_1/actions"]
    file["data/demo_1/actions"] = np.zeros((5, 8), np.float32)


ROBOMIMIC = {
    "external link": _external,
    "external data": _elsewhere,
    "virtual data": _virtual,
    "soft link": lambda file: file.update({"data/demo_0/x": h5py.SoftLink("/data")}),
    "circle": _circle,
    "names": _names,
    "huge": _huge,
    "huge together": _together,
    "rate": _rate,
    "short": _short,
    "missing": lambda file: file["data/demo_1"].pop("rewards"),
    "no demos": lambda file: [file["data"].pop(name) for name in list(file["data"])],
}


@pytest.mark.parametrize("kind", ROBOMIMIC)
def test_bad_robomimic_files(copy, kind):
    path = copy("robomimic")
    _edit(path, ROBOMIMIC[kind])
    assert refused(path, "robomimic")


def _header(path, name, **changed):
    file = path / name / ".zarray"
    file.write_text(json.dumps(json.loads(file.read_text()) | changed))


def _ends(path, ends):
    whole = zarr.open_array(str(path / "meta/episode_ends"), mode="r+")
    whole[:] = ends


IMAGE = "data/image_camera/3.0.0.0"
ZARR = {
    "cut chunk": lambda d: os.truncate(d / "data/action/0.0", 20),
    "cut image": lambda d: os.truncate(d / IMAGE, (d / IMAGE).stat().st_size // 2),
    "no image": lambda d: (d / IMAGE).unlink(),
    "header": lambda d: (d / "data/action/.zarray").write_text("{"),
    "frames": lambda d: _header(d, "data/action", shape=[9, 8]),
    "huge": lambda d: _header(d, "data/action", shape=[12, 10**12]),
    "chunks": lambda d: _header(d, "data/action", chunks=[1, 0]),
    "many ends": lambda d: _header(d, "meta/episode_ends", shape=[2**31], chunks=[1]),
    "ends": lambda d: _ends(d, [12, 6]),
    "no ends": lambda d: shutil.rmtree(d / "meta"),
    "link": lambda d: (d / "data/x").symlink_to("/etc"),
    "attributes": lambda d: (d / ".zattrs").write_bytes(b"\x94\xfd"),
}


@pytest.mark.parametrize("kind", ZARR)
def test_bad_zarr_folders(copy, kind):
    path = copy("zarr")
    ZARR[kind](path)
    assert refused(path, "zarr")


def test_black_images_are_written(tmp_path):
    """Chunks of zeros could be left out, as if they were lost."""
    image = base.Column((8, 8, 3), "uint8")
    read = lambda episode, names: {"image": np.zeros((4, 8, 8, 3), np.uint8)}  # noqa: E731
    made = base.Source(30.0, [4], {"image": image}, read)
    base.FORMATS.get("zarr").write(tmp_path / "d", made, False)
    with base.open_dataset(tmp_path / "d", "zarr") as source:
        assert not source.read(0, ["image"])["image"].any()


@pytest.mark.parametrize("name", NAMES)
def test_another_formats_reader_refuses_it(sound, name):
    readers = {other: base.FORMATS.get(other).open for other in NAMES}
    for other in (x for x in NAMES if readers[x] is not readers[name]):
        assert refused(sound[name], other)


def test_columns_that_are_not_there_are_named(sound):
    with base.open_dataset(sound["zarr"], "zarr") as source, mistakes.of("column", "actoin"):
        source.read(0, ["actoin"])


@pytest.mark.parametrize("name", NAMES)
def test_accidents_end_in_arrays_or_in_a_line(tmp_path, name):
    found = fuzz_formats.run(fuzz_formats.prepared(tmp_path, name), name, 120, seed=0)
    assert set(found) == {"read", "refused"}, found


def test_what_is_brought_back_stays_in_its_folder(tmp_path):
    path = fuzz_formats.prepared(tmp_path, "lerobot", whole=True)
    found = fuzz_formats.run(path, "lerobot", 60, seed=1, back=True)
    assert set(found) == {"read", "refused"}, found
    assert {p.name for p in tmp_path.iterdir()} <= {"d", "out", "deep"}
    assert {p.name for p in (tmp_path / "deep").iterdir()} == {"er"}


def test_more_rows_than_an_episode_has_are_not_unpacked(copy, monkeypatch):
    path = copy("lerobot")
    with base.open_dataset(path, "lerobot") as source:
        names = [name for name, about in source.columns.items() if not about.is_image]
    row = parquet.read_table(path / DATA).slice(0, 1)
    parquet.write_table(row.take(pa.array(np.zeros(300_000, np.int64))), path / DATA)
    del row
    pool = pa.system_memory_pool()
    monkeypatch.setattr(lerobot, "_BATCH", 1 << 8)
    with pytest.raises(errors.UsageError) as caught, base.open_dataset(path, "lerobot") as source:
        pa.set_memory_pool(pool)
        before = pool.max_memory()
        source.read(0, names)
    pa.set_memory_pool(pa.default_memory_pool())
    assert caught.value.got.endswith("more") and pool.max_memory() - before < 1 << 24


def test_cells_longer_than_their_column_are_refused(copy):
    path = copy("lerobot")
    rewritten(path / DATA, "action", lambda old: pa.array([[0.0] * 1000] * len(old)))
    assert "numbers" in refused(path, "lerobot")


def test_links_into_the_cache_of_the_hub_are_followed(copy, tmp_path):
    path = copy("lerobot")
    cache = tmp_path / "datasets--someone--something"
    snapshot, blobs = cache / "snapshots" / "0a1b2c", cache / "blobs"
    blobs.mkdir(parents=True)
    for i, file in enumerate(sorted(path.rglob("*"))):
        if file.is_file():
            link = snapshot / file.relative_to(path)
            link.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(file, blobs / str(i))
            link.symlink_to(os.path.relpath(blobs / str(i), link.parent))
    with base.open_dataset(snapshot, "lerobot") as source:
        assert source.read(0, source.columns)
    outside = tmp_path / "outside.parquet"
    shutil.copy(path / DATA, outside)
    (snapshot / DATA).unlink()
    (snapshot / DATA).symlink_to(outside)
    assert "a link to" in refused(snapshot, "lerobot")


def test_a_video_that_starts_off_the_frames_before_is_noted(copy):
    """As after merges that add up durations instead of frames: the neighbour's images."""
    path = copy("lerobot")
    with base.open_dataset(path, "lerobot") as source:
        assert not source.notes
        hz, length = source.hz, source.lengths[0]
    name = "videos/observation.images.camera/from_timestamp"
    off = [0.0, (length + 1) / hz]
    rewritten(path / EPISODES, name, lambda cells: pa.array(off, cells.type))
    with base.open_dataset(path, "lerobot") as source:
        (note,) = source.notes
    assert f"frame {length + 1}" in note and "file-000.mp4" in note


def test_other_kinds_of_columns_are_left_out_with_a_note(copy):
    path = copy("lerobot")
    features = info(path)["features"]
    features["depth"] = {"dtype": "image", "shape": [40, 96, 1], "names": None}
    features["said"] = {"dtype": "language", "shape": [1], "names": None}
    info(path, features=features)
    with base.open_dataset(path, "lerobot") as source:
        assert not {"depth", "said"} & set(source.columns) and len(source.notes) == 2
        assert source.read(0, ["action"])
