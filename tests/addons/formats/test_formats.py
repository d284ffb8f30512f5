"""Exports and imports: back as they were, with the columns that peers expect, also after a kill."""

import importlib.metadata
import json
import shutil
from typing import Any

import h5py
import kill
import mistakes
import numpy as np
import pyarrow.parquet
import pytest
import recorded
import zarr
from scipy.spatial import transform

from starjax import rcm
from starjax.addons.formats import base, exchange, foreign, own_columns, peer_columns
from starjax.core import errors
from starjax.data import load, pose_rows, store
from starjax.sim.rollouts import episodes

KINDS = {
    "state": {},
    "images": {"size": 32, "cameras": 2},
    "two_arms": {"arms": 2, "demos": 2},
    "wrist": {"demos": 2, "wrist": True},
}
EXACT = {"robomimic": True, "zarr": True, "lerobot": False}  # and whether images go into videos
SUFFIX = {"robomimic": ".hdf5"}


@pytest.fixture(scope="module")
def roots(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sealed")
    for name, given in KINDS.items():
        recorded.write(folder / name, **given)
    return folder


@pytest.fixture(scope="module")
def exported(roots, tmp_path_factory):
    """(kind, format, video) -> path of the export, made once."""
    made = {}

    def find(kind, name, video=False):
        at = (kind, name, video)
        if at not in made:
            form = base.FORMATS.get(name)
            made[at] = tmp_path_factory.mktemp("out") / f"{kind}{SUFFIX.get(name, '')}"
            exchange.export(exchange.source(roots / kind, form), made[at], form, video)
        return made[at]

    return find


def restore(path, root, **given):
    with base.open_dataset(path, base.detect(path)) as source:
        return exchange.restore_export(source, root, **given)


@pytest.mark.parametrize("name", base.writable())
@pytest.mark.parametrize("kind", KINDS)
def test_an_export_comes_back_to_the_last_byte(roots, exported, tmp_path, kind, name):
    found = restore(exported(kind, name), tmp_path / "back")
    assert found["same"] and found["digest"] == store.read_seal(roots / kind)["digest"]
    assert kill.tree(tmp_path / "back") == kill.tree(roots / kind)


def test_videos_lose_little_and_nothing_else(roots, exported, tmp_path):
    found = restore(exported("images", "lerobot", True), tmp_path / "back")
    assert not found["same"]
    before, after = kill.tree(roots / "images"), kill.tree(tmp_path / "back")
    assert before.keys() == after.keys()
    differing = {name for name in before if before[name] != after[name]}
    assert {name.rpartition("/")[2].partition("_")[0] for name in differing} == {
        "image",
        "episode.json",
        "SEALED.json",
    }
    for camera in recorded.CAMERAS:
        one, other = (
            load.frames(root)[camera].read().astype(float)
            for root in (roots / "images", tmp_path / "back")
        )
        assert 10 * np.log10(255**2 / np.mean((one - other) ** 2)) >= 35.0


def test_columns_of_a_wrist_are_those_of_a_tool_that_has_one(roots):
    form = base.FORMATS.get("zarr")
    of_wrist = {form.named(f"{base.OURS}.{name}") for name in ("wrist", "command_wrist", "shaft_R")}
    columns = {kind: set(exchange.source(roots / kind, form).columns) for kind in KINDS}
    assert of_wrist <= columns["wrist"] and not of_wrist & (columns["state"] | columns["two_arms"])
    loaded = load.load(roots / "wrist").dataset
    assert loaded.observation.wrist.shape == loaded.command.wrist.shape
    assert load.load(roots / "state").dataset.command.wrist is None
    with mistakes.of("actions", "rcm4"):
        exchange.source(roots / "wrist", form, options=peer_columns.PeerOptions(actions="rcm4"))


@pytest.mark.parametrize("kind", ["state", "two_arms"])
def test_peers_columns_say_what_ours_say(roots, kind):
    form = base.FORMATS.get("zarr")
    source = exchange.source(roots / kind, form)
    names = ["state", "action", "trocar", "reward", "done", "environment_state"]
    key = store.keys(roots / kind)[1]
    record = store.verify(roots / kind, key)
    ours = {name: np.load(roots / kind / "episodes" / key / name) for name in record["files"]}
    found = source.read(1, names)
    arms = len(record["radius"])
    for column, before in (("state", ""), ("action", "command_")):
        rows = found[column].reshape(-1, arms, 8)
        np.testing.assert_array_equal(rows[..., :3], ours[f"{before}p.npy"])
        R = transform.Rotation.from_quat(rows[..., 3:7].reshape(-1, 4)).as_matrix()
        np.testing.assert_allclose(R, ours[f"{before}R.npy"].reshape(-1, 3, 3), atol=1e-6)
        assert (np.sum(rows[1:, :, 3:7] * rows[:-1, :, 3:7], -1) > 0).all()  # no jumps
        np.testing.assert_array_equal(rows[..., 7], ours[f"{before}gripper.npy"])
        assert len(source.columns[column].names) == 8 * arms
    description = store.read_description(roots / kind)
    offset = found["trocar"].reshape(-1, arms, 3) - np.float32(description["p_world_ref"])
    np.testing.assert_allclose(np.linalg.norm(offset, axis=-1)[0], record["radius"], atol=1e-6)
    np.testing.assert_array_equal(found["environment_state"], ours["state.npy"])
    last = np.arange(record["length"]) == record["length"] - 1
    np.testing.assert_array_equal(found["done"], last)
    np.testing.assert_array_equal(found["reward"], last)


@pytest.mark.parametrize("kind", ["state", "two_arms"])
def test_options_carry_the_trocar_and_the_manifold(roots, kind):
    """The state ends with the trocar; actions decode through it to the commands that were given."""
    form = base.FORMATS.get("zarr")
    plain = exchange.source(roots / kind, form)
    options = peer_columns.PeerOptions(state_with_trocar=True, actions="rcm4")
    source = exchange.source(roots / kind, form, options=options)
    before, after = (x.read(1, ["state", "action", "trocar"]) for x in (plain, source))
    width = before["state"].shape[1]
    arms = width // 8
    np.testing.assert_array_equal(after["state"][:, :width], before["state"])
    np.testing.assert_array_equal(after["state"][:, width:], before["trocar"])
    description = store.read_description(roots / kind)
    reference, roll_zero = (np.float32(description[x]) for x in ("p_world_ref", "roll_zero"))
    trocar = rcm.trocar_from_position(before["trocar"].reshape(-1, arms, 3), reference)
    frame = rcm.trocar_frame(trocar, reference, roll_zero)
    rows = after["action"].reshape(-1, arms, 5)
    pose, _ = rcm.ACTION_SPACES["rcm4"].decode(rows[..., :4], frame)
    wanted = pose_rows.unpack("action", before["action"])
    np.testing.assert_allclose(pose.p, wanted[0], atol=1e-6)
    np.testing.assert_allclose(pose.R, wanted[1], atol=1e-4)
    np.testing.assert_array_equal(rows[..., 4], wanted[2].astype(np.float32))
    assert np.abs(np.diff(rows[..., 0], axis=0)).max() < np.pi
    for name in ("state", "action"):
        assert len(source.columns[name].names) == after[name].shape[1]


@pytest.mark.parametrize("kind", KINDS)
def test_an_edited_export_is_read_by_our_columns(exported, roots, tmp_path, kind):
    """As LeRobot's tools leave it: fewer episodes, columns flat, meta/starjax.json gone."""
    form = base.FORMATS.get("lerobot")
    with base.open_dataset(exported(kind, "lerobot"), "lerobot") as source:

        def read(episode, names):
            return source.read(episode + 1, names)

        fewer = source._replace(lengths=source.lengths[1:], read=read, origin=None)
        exchange.export(fewer, tmp_path / "cut", form, False)
    with base.open_dataset(tmp_path / "cut", "lerobot") as cut:
        if kind == "two_arms":
            with mistakes.of("--map: arms"):
                foreign.import_mapped(cut, own_columns.mapping(cut), tmp_path / "d", tmp_path)
            cut = cut._replace(task="peg transfer bimanual")
        mapping = own_columns.mapping(cut)
        found = foreign.import_mapped(cut, mapping, tmp_path / "d", tmp_path)
    assert found.episodes == len(store.keys(roots / kind)) - 1 - 1
    ours, theirs = (
        load.load(root, residency="host", report=lambda _: None).dataset
        for root in (roots / kind, tmp_path / "d")
    )
    rows = slice(ours.start[1], None)
    for name in ("p", "R"):
        np.testing.assert_allclose(
            getattr(theirs.observation.pose, name), getattr(ours.observation.pose, name)[rows],
            atol=1e-6,
        )  # fmt: skip
    np.testing.assert_allclose(theirs.command.pose.p, ours.command.pose.p[rows], atol=1e-6)
    np.testing.assert_allclose(
        theirs.trocar.p_world_trocar, ours.trocar.p_world_trocar[1:], atol=1e-6
    )
    assert kind == "two_arms" or not found.notes
    has_shaft = "shaft_p" in store.read_description(tmp_path / "d")["features"]
    assert has_shaft == (kind == "wrist")
    if kind == "images":  # one of the task's cameras
        roots_of = (roots / kind, tmp_path / "d")
        one, other = (load.frames(root)[recorded.CAMERAS[0]].read() for root in roots_of)
        np.testing.assert_array_equal(other, one[rows])
    unnamed = cut._replace(task="fold a towel")
    with mistakes.of("PATH", "towel"):
        own_columns.mapping(unnamed)


def test_robomimic_has_its_groups(exported):
    opened: Any = h5py.File(exported("images", "robomimic"))
    with opened as file:
        assert json.loads(file["data"].attrs["env_args"]).keys() >= {"env_name", "env_kwargs"}
        assert file["data"].attrs["total"] == 120 and len(file["data"]) == 4
        demo = file["data/demo_3"]
        assert demo.attrs["num_samples"] == 30 and np.abs(demo["actions"]).max() <= 1.0
        assert demo["obs/wrist_image"].shape == (30, 32, 32, 3)
        assert demo["obs/wrist_image"].chunks == (1, 32, 32, 3)
        assert file["mask/train"].asstr()[3] == "demo_3"


def test_robomimic_refuses_actions_that_its_learners_would_clip(roots, tmp_path):
    form = base.FORMATS.get("robomimic")
    source = exchange.source(roots / "state", form)

    def far(episode, names):
        return {name: 20.0 * array for name, array in source.read(episode, names).items()}

    with pytest.raises(base.Damaged):
        exchange.export(source._replace(read=far), tmp_path / "out.hdf5", form)
    assert not list(tmp_path.iterdir())


def test_zarr_is_of_version_2(exported):
    path = exported("images", "zarr")
    assert (path / ".zgroup").exists() and not list(path.rglob("zarr.json"))
    root: Any = zarr.open_group(str(path), mode="r", zarr_format=2)
    assert root["meta/episode_ends"][:].tolist() == [30, 60, 90, 120]
    assert json.loads((path / "meta/episode_ends/.zarray").read_text())["compressor"] is None
    assert root["data/image_wrist"].shape == (120, 32, 32, 3)
    assert root["data/image_wrist"].chunks == (1, 32, 32, 3)


@pytest.mark.parametrize("video", [False, True])
def test_lerobot_has_its_tables(exported, video):
    path = exported("images", "lerobot", video)
    info = json.loads((path / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0" and info["fps"] == 30
    assert (info["total_episodes"], info["total_frames"]) == (4, 120)
    image = "observation.images.wrist"
    assert info["features"][image]["dtype"] == ("video" if video else "image")
    table = pyarrow.parquet.ParquetFile(path / "data/chunk-000/file-000.parquet")
    assert table.num_row_groups == 4 and (image in table.schema_arrow.names) != video
    described = json.loads(table.schema_arrow.metadata[b"huggingface"])["info"]["features"]
    assert described.keys() == set(table.schema_arrow.names)
    rows = pyarrow.parquet.read_table(path / "meta/episodes/chunk-000/file-000.parquet")
    assert rows["dataset_to_index"].to_pylist() == [30, 60, 90, 120]
    stats = json.loads((path / "meta/stats.json").read_text())
    assert np.shape(stats[image]["q99"]) == (3, 1, 1) and 0 <= stats[image]["min"][0][0][0] <= 1
    state = np.stack(pyarrow.parquet.read_table(path / "data")["observation.state"].to_pylist())
    np.testing.assert_allclose(stats["observation.state"]["q10"], np.quantile(state, 0.1, axis=0))
    if video:
        begins = rows[f"videos/{image}/from_timestamp"].to_pylist()
        assert begins == [0.0, 1.0, 2.0, 3.0]


def test_the_card_has_a_header_and_every_feature(exported):
    path = exported("images", "lerobot", True)
    _, header, text = (path / "README.md").read_text().split("---\n", 2)
    assert "- LeRobot" in header and "data_files: data/*/*.parquet" in header
    info = json.loads((path / "meta/info.json").read_text())
    shown = [name for name in info["features"] if not name.startswith(base.OURS)]
    assert all(f"`{name}`" in text for name in shown)


def test_files_of_lerobot_are_split_by_size(roots, tmp_path, monkeypatch):
    from starjax.addons.formats import lerobot_tables, lerobot_write

    monkeypatch.setattr(lerobot_write, "DATA_MB", 0)
    monkeypatch.setattr(lerobot_write, "VIDEO_MB", 0)
    monkeypatch.setattr(lerobot_tables, "CHUNK", 3)
    form = base.FORMATS.get("lerobot")
    exchange.export(exchange.source(roots / "images", form), tmp_path / "out", form, True)
    assert (tmp_path / "out/data/chunk-001/file-000.parquet").exists()
    assert (tmp_path / "out/videos/observation.images.wrist/chunk-001/file-000.mp4").exists()
    restore(tmp_path / "out", tmp_path / "back")
    before, after = kill.tree(roots / "images"), kill.tree(tmp_path / "back")
    assert {n for n in before if "p.npy" in n and before[n] != after[n]} == set()


def as_v21(path, out):
    """The dataset as LeRobot's version 2.1 lays it out."""
    info = json.loads((path / "meta/info.json").read_text())
    table = pyarrow.parquet.read_table(path / "data")
    (out / "meta").mkdir(parents=True)
    (out / "data/chunk-000").mkdir(parents=True)
    lines = []
    for episode in range(info["total_episodes"]):
        mine = table.filter(pyarrow.compute.equal(table["episode_index"], episode))
        pyarrow.parquet.write_table(mine, out / f"data/chunk-000/episode_{episode:06d}.parquet")
        lines.append({"episode_index": episode, "tasks": ["t"], "length": len(mine)})
    (out / "meta/episodes.jsonl").write_text("\n".join(map(json.dumps, lines)) + "\n")
    (out / "meta/tasks.jsonl").write_text('{"task_index": 0, "task": "move it"}\n')
    info |= {"codebase_version": "v2.1"}
    (out / "meta/info.json").write_text(json.dumps(info))
    return out


def test_version_2_1_of_lerobot_is_read(exported, tmp_path):
    path = exported("images", "lerobot")
    with (
        base.open_dataset(path, "lerobot") as modern,
        base.open_dataset(as_v21(path, tmp_path / "old"), "lerobot") as old,
    ):
        assert list(old.lengths) == list(modern.lengths) and old.columns == modern.columns
        assert old.task == "move it" and old.origin is None
        for episode in (0, 3):
            found = (source.read(episode, source.columns) for source in (old, modern))
            for one, other in zip(*(arrays.values() for arrays in found), strict=True):
                np.testing.assert_array_equal(one, other)


def test_a_stopped_import_goes_on(exported, roots, tmp_path):
    counts = []

    def stop(count):
        counts.append(count)
        if len(counts) == 3:
            raise KeyboardInterrupt

    path = exported("state", "zarr")
    with pytest.raises(KeyboardInterrupt):
        restore(path, tmp_path / "back", note=stop)
    assert not store.is_sealed(tmp_path / "back") and len(store.keys(tmp_path / "back")) == 3
    written = {path: path.stat().st_mtime_ns for path in (tmp_path / "back").rglob("*.npy")}
    restore(path, tmp_path / "back", note=counts.append)
    assert all(path.stat().st_mtime_ns == time for path, time in written.items())
    assert kill.tree(tmp_path / "back") == kill.tree(roots / "state")


@pytest.mark.parametrize("name", base.writable())
def test_a_stopped_export_leaves_nothing(roots, tmp_path, name):
    form = base.FORMATS.get(name)
    done = []

    def stop(count):
        done.append(count)
        if len(done) == 3:
            raise KeyboardInterrupt

    source = exchange.source(roots / "images", form)
    with pytest.raises(KeyboardInterrupt):
        exchange.export(source, tmp_path / "out", form, True, stop)
    assert not list(tmp_path.iterdir())


def test_a_format_that_writes_nothing_is_named(roots, tmp_path):
    form = base.FORMATS.get("zarr")._replace(write=lambda path, source, video: None)
    with pytest.raises(errors.UsageError) as caught:
        exchange.export(exchange.source(roots / "state", form), tmp_path / "out", form)
    assert "write (test_formats.py:" in caught.value.argument and not list(tmp_path.iterdir())


def _key(origin):
    origin["records"][0]["key"] = "../../escaped"


def _field(origin):
    about = origin["description"]["features"]
    about["../p"] = about.pop("p")
    origin["columns"]["../p"] = origin["columns"].pop("p")


CHANGES = {
    "key": _key,
    "field": _field,
    "length": lambda origin: origin["records"][0].update(length=7),
    "records": lambda origin: origin["records"].pop(),
    "columns": lambda origin: origin["columns"].update(p="starjax.R"),
    "features": lambda origin: origin["description"].pop("features"),
    "description": lambda origin: origin.update(description=[]),
    "stored": lambda origin: origin.update(stored=None),
}


@pytest.mark.parametrize("change", CHANGES)
def test_what_an_export_says_of_itself_is_not_trusted(exported, tmp_path, change):
    path = shutil.copytree(exported("state", "lerobot"), tmp_path / "in")
    ours = path / "meta/starjax.json"
    origin = json.loads(ours.read_text())
    CHANGES[change](origin)
    ours.write_text(json.dumps(origin))
    with pytest.raises(errors.UsageError):
        restore(path, tmp_path / "deep/er/back")
    assert {p.name for p in tmp_path.iterdir()} <= {"in", "deep"}
    assert not list((tmp_path / "deep").rglob("*.npy"))


def test_what_is_no_dataset_is_named(roots, tmp_path):
    for path in (tmp_path / "nowhere", tmp_path):
        with mistakes.of("PATH", path):
            base.detect(path)
    form = base.FORMATS.get("zarr")
    shutil.copytree(roots / "state", tmp_path / "d")
    (tmp_path / "d/SEALED.json").unlink()
    with pytest.raises(ValueError, match="complete"):
        exchange.source(tmp_path / "d", form)


def test_a_damaged_dataset_is_not_exported(roots, tmp_path):
    root = shutil.copytree(roots / "state", tmp_path / "d")
    file = root / "episodes" / store.keys(root)[0] / "p.npy"
    file.write_bytes(file.read_bytes()[:-4])
    with pytest.raises(store.DamagedEpisode, match=r"p\.npy"):
        exchange.source(root, base.FORMATS.get("zarr"))


def test_every_field_of_a_demonstration_has_a_column(roots):
    source = exchange.source(roots / "images", base.FORMATS.get("robomimic"))
    assert source.origin is not None
    named = source.origin["columns"]
    assert named.keys() >= {"p", "R", "qpos", f"{episodes.IMAGE}wrist"}
    assert set(named.values()) <= set(source.columns)


def test_version_2_1_has_a_file_an_episode_and_its_modality(roots, exported):
    path = exported("two_arms", "lerobot-v2.1")
    info = json.loads((path / "meta/info.json").read_text())
    assert info["codebase_version"] == "v2.1" and info["total_chunks"] == 1
    lines = (path / "meta/episodes_stats.jsonl").read_text().splitlines()
    assert len(lines) == info["total_episodes"] == len(list(path.glob("data/*/*.parquet")))
    assert json.loads(lines[1])["stats"]["observation.state"]["count"] == [30]
    table = pyarrow.parquet.read_table(path / "data/chunk-000/episode_000001.parquet")
    assert table["instruction.text"].unique().to_pylist() == ["peg transfer"]
    modality = json.loads((path / "meta/modality.json").read_text())
    source = exchange.source(roots / "two_arms", base.FORMATS.get("lerobot-v2.1"))
    names = source.columns["observation.state"].names
    for kind, parts in (("state", "observation.state"), ("action", "action")):
        span = modality[kind]["arm1_gripper"]
        assert span["original_key"] == parts and names[span["start"]] == "arm1_gripper"
    assert modality["state"]["arm1_trocar"] == {
        "start": 3,
        "end": 6,
        "original_key": "observation.trocar",
    }


@pytest.mark.parametrize("name", base.writable())
def test_failures_come_last_and_are_restored_in_their_order(tmp_path, name):
    recorded.write(tmp_path / "d", failures=True)
    form = base.FORMATS.get(name)
    source = exchange.source(tmp_path / "d", form)
    assert source.splits == {"train": range(3), "failure": range(3, 4)}
    out = tmp_path / f"out{SUFFIX.get(name, '')}"
    exchange.export(source, out, form)
    if "lerobot" in name:
        splits = json.loads((out / "meta/info.json").read_text())["splits"]
        assert splits == {"train": "0:3", "failure": "3:4"}
    assert restore(out, tmp_path / "back")["same"]
    assert kill.tree(tmp_path / "back") == kill.tree(tmp_path / "d")


def test_a_broken_format_leaves_the_others(tmp_path, monkeypatch):
    broken = importlib.metadata.EntryPoint("notes", "nowhere_at_all:FORMAT", "starjax.formats")
    monkeypatch.setattr(type(base.FORMATS), "_entries", lambda self: [broken])
    (tmp_path / "d" / "meta").mkdir(parents=True)
    (tmp_path / "d" / "meta" / "info.json").touch()
    assert base.detect(tmp_path / "d") == "lerobot"
    with pytest.warns(UserWarning, match="skipped"), pytest.raises(errors.UsageError):
        base.detect(tmp_path)  # a file of no format: the broken ones are asked too


def test_a_format_of_two_packages_fails_alone(tmp_path, monkeypatch):
    value = "starjax.addons.formats.csv:FORMAT"
    again = importlib.metadata.EntryPoint("csv", value, "starjax.formats")
    monkeypatch.setattr(type(base.FORMATS), "_entries", lambda self: [again])
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").touch()
    assert base.detect(tmp_path) == "lerobot"
    with pytest.warns(UserWarning, match="csv is skipped"):
        assert {"lerobot", "zarr", "robomimic"} <= set(base.writable())
