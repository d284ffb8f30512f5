"""Mappings of the package: each is chosen by its dataset's columns, and finds the trocars."""

import json

import kill
import mistakes
import numpy as np
import openh
import pytest
from msgspec import structs

from starjax.addons.formats import base, foreign, mapping, ready
from starjax.core import errors
from starjax.data import load, schema, store
from starjax.sim import registries

WRISTED = {"open-h-stanford", "open-h-ucb"}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Name -> (its LeRobot folder, findings of the import by the chosen mapping, the dataset)."""
    made = {}

    def find(name):
        if name not in made:
            folder = tmp_path_factory.mktemp(name)
            path = openh.write(folder / "lerobot", name)
            with base.open_dataset(path, base.detect(path)) as source:
                chosen = ready.choose(source)
                columns = mapping.load(ready.find(chosen))
                found = foreign.import_mapped(source, columns, folder / "d", ready.FOLDER)
            made[name] = path, chosen, found, folder / "d"
        return made[name]

    return find


@pytest.mark.parametrize("name", ready.names())
def test_mappings_name_tasks_and_their_cameras(name):
    found = mapping.load(ready.find(name))
    task = registries.tasks.get(found.task)
    assert found.about and found.fits and set(found.cameras) <= set(task.cameras)
    assert len(found.arms) == len(task.slots)


@pytest.mark.parametrize("name", openh.SHAPES)
def test_the_mapping_that_fits_is_chosen_and_its_trocars_are_the_tasks(written, name):
    _, chosen, found, root = written(name)
    assert chosen == name and found.episodes == 4
    description = store.read_description(root)
    reference = np.array(description["p_world_ref"])
    # The files' frame is no task's: the mean trocar is put at the nominal one.
    offset = found.p_world_trocar.mean((0, 1)) - reference.mean(0)
    assert np.linalg.norm(offset) < 1e-6
    assert found.residual_mm.max() < 0.05
    apart = np.linalg.norm(np.diff(found.p_world_trocar, axis=1), axis=-1)
    np.testing.assert_allclose(apart, np.linalg.norm(np.diff(openh.TROCARS, axis=0)), atol=1e-4)


@pytest.mark.parametrize("name", openh.SHAPES)
def test_the_motion_is_the_files_up_to_one_rigid_one(written, name):
    """Distances between tips, which no frame changes."""
    *_, root = written(name)
    dataset = load.load(root, residency="host", report=lambda _: None).dataset
    episodes = [i for i in range(4) if i != 3]  # the last one is in the split of failures
    assert len(dataset.length) == len(episodes)
    for k, episode in enumerate(episodes):
        first = int(dataset.start[k])
        tips = dataset.observation.pose.p[first : first + openh.STEPS]
        arms = tips.shape[1]
        for i in range(arms):
            trocar = openh.TROCARS[i] if arms > 1 else openh.TROCARS[0]
            p = openh.tips(trocar, arms * episode + i, name in WRISTED)
            np.testing.assert_allclose(
                np.linalg.norm(tips[1:, i] - tips[0, i], axis=-1),
                np.linalg.norm(p[1:] - p[0], axis=-1),
                atol=1e-4,
            )
    assert dataset.observation.images is not None
    (images,) = dataset.observation.images.values()
    assert images.shape[1:] == (128, 128, 3)


def test_splits_are_recorded_and_failures_are_not_learned_from(written):
    *_, root = written("open-h-dvrk")
    records = sorted((store.verify(root, key) for key in store.keys(root)), key=_number)
    assert [record["splits"] for record in records] == [["train"]] * 2 + [["test"], ["failure"]]
    assert [record["success"] for record in records] == [True] * 3 + [False]


def _number(record):
    return record["episode"]


def test_texts_are_kept(written):
    *_, root = written("open-h-dvrk")
    about = json.loads((root / schema.IMPORTED).read_text())
    depth, squeezed = about["columns"]  # depth, which no mapping names
    assert "depth" in depth and "side" in squeezed and not about["notes"]
    texts = about["texts"]
    assert texts["instruction.text"] == {"pick up the needle": 4}
    assert texts["observation.meta.tool.psm1"] == {"Large Needle Driver": 4}
    assert texts["task"] == {"move about": 4}


def test_a_recorded_remote_centre_is_read(written):
    _, _, found, _ = written("tud-ur5e")
    assert len(np.unique(found.p_world_trocar.round(9), axis=0)) == 1 and not found.notes


def bring(source, tmp_path, **changed):
    columns = mapping.load(ready.find(ready.choose(source)))
    columns = structs.replace(columns, **changed)
    return foreign.import_mapped(source, columns, tmp_path / "d", ready.FOLDER)


def test_splits_and_episodes_are_chosen(tmp_path):
    made = openh.source("tud-ur5e")._replace(splits={"train": range(2), "test": range(2, 4)})
    found = bring(made, tmp_path, splits=("test",), skip=(3,))
    numbers = [store.verify(tmp_path / "d", k)["episode"] for k in store.keys(tmp_path / "d")]
    assert numbers == [2] and (found.episodes, found.left_out) == (1, 3)
    with mistakes.of("splits", "val"):
        bring(made, tmp_path, splits=("val",))
    with mistakes.of("skip", "4"):
        bring(made, tmp_path, skip=(4,))


def test_wristed_poses_alone_show_no_trocar(tmp_path):
    for name in ("open-h-dvrk", "open-h-hamlyn"):
        with mistakes.of("PATH", "left out"):
            bring(openh.source(name, wristed=True), tmp_path)


@pytest.mark.parametrize("what", ["numbers", "images"])
def test_one_bad_episode_is_left_out(tmp_path, what):
    made = openh.source("tud-ur5e")

    def read(i, names):
        if i == 1 and (what == "numbers") == ("observation.state" in names):
            raise errors.UsageError("x", "90 rows", 89)
        return made.read(i, names)

    found = bring(made._replace(read=read), tmp_path)
    assert (found.episodes, found.left_out) == (3, 1)
    assert [note.startswith("episode 1:") for note in found.notes] == [True]
    dataset = load.load(tmp_path / "d", residency="host", report=lambda _: None).dataset
    assert len(dataset.length) == 3 and found.frames == int(np.sum(dataset.length))
    # A second call finds the same.
    before = kill.tree(tmp_path / "d")
    (tmp_path / "d" / "SEALED.json").unlink()
    assert bring(made._replace(read=read), tmp_path).episodes == 3
    assert before.keys() == kill.tree(tmp_path / "d").keys()


def test_no_episode_left_is_the_first_ones_error(tmp_path):
    made = openh.source("tud-ur5e")

    def read(i, names):
        raise errors.UsageError("x", "90 rows", i)

    with mistakes.of("x", "0 in episode 0"):
        bring(made._replace(read=read), tmp_path)


def test_a_dataset_that_none_fits_is_told(tmp_path):
    made = openh.source("tud-ur5e")
    with mistakes.of("--map", "none"):
        ready.choose(made._replace(columns={"x": made.columns["action"]}))
    with mistakes.of("--map", "open-h-dvkr"):
        ready.find("open-h-dvkr")


def test_older_records_of_mappings_hold():
    arm = mapping.ArmColumns(position="p", rotation="q")
    recorded = mapping.as_json(mapping.Map(task="reach", arms=(arm,)))
    newer = {"about", "fits", "skip", "splits", "place"}
    assert not newer & set(recorded) and "trocar_at" not in recorded["arms"][0]
