"""Recorded trials of an evaluation on the page."""

import json

import mistakes
import numpy as np
import pytest
import recorded

from starjax.addons.viewer import browse, page, trials
from starjax.addons.viewer.commands import view
from starjax.runtime import files
from starjax.sim import scene

NAMES = scene.name("reach")


@pytest.fixture
def folder(tmp_path):
    """Two trials that diverged, of 5 and 3 control steps."""
    model = scene.compose(NAMES)
    qpos = np.tile(model.qpos0.astype(np.float32), (2, 5, 1))
    qpos[1, 3:] = np.nan
    tips = np.zeros((2, 5, 1, 3), np.float32)
    columns = {"trocar": [2, 9], "trial": [7, 0], "length": [5, 3], "labels.target": [4, 1]}
    columns |= {"qpos": qpos, "p_world_tip": tips, "p_world_trocar": np.full((2, 1, 3), 0.1)}
    arrays = {name: np.asarray(values) for name, values in columns.items()}
    files.write_npz(tmp_path / "invalid.npz", arrays)
    (tmp_path / "plan.json").write_text(json.dumps({"scene": NAMES._asdict()}))
    return tmp_path


def test_a_trial_that_diverged_is_shown_to_its_last_sound_state(folder):
    found = trials.load(folder / "invalid.npz")
    assert list(found.keys) == ["trocar 2, trial 7", "trocar 9, trial 0"] and found.hz == 30.0
    shown = found.read(found.keys[1])
    assert len(shown.frames) == 3 and shown.outcome == "invalid"
    assert [frame.invalid for frame in shown.frames] == [False, False, True]
    assert all(np.isfinite(frame.qpos).all() for frame in shown.frames)


def test_what_is_not_there_is_one_line(folder, tmp_path):
    with mistakes.of("--trials"):
        view._trials(str(folder / "other.npz"))
    arrays = dict(np.load(folder / "invalid.npz"))
    del arrays["qpos"]
    files.write_npz(folder / "without.npz", arrays)
    with mistakes.of("--trials", "without.npz"):
        view._trials(str(folder / "without.npz"))
    (folder / "invalid.npz").write_bytes(b"no")
    with mistakes.of("--trials"):
        view._trials(str(folder / "invalid.npz"))
    with mistakes.of("--policy, --run, --expert, --dataset or --trials"):
        view.main(["--trials", "a.npz", "--expert"])


def test_a_scene_without_a_camera_is_shown_alone(folder, tmp_path):
    bare = NAMES._replace(cameras=())
    (folder / "plan.json").write_text(json.dumps({"scene": bare._asdict()}))
    recordings = trials.load(folder / "invalid.npz")
    looks = iter([False] * 6)
    with page.serve(page.ANY) as server:
        summary = browse.run(server, recordings, lambda: next(looks, True))
    assert summary.startswith("1 of 2")
    recorded.write(tmp_path / "demos")
    dataset = browse.open_dataset(tmp_path / "demos")
    assert not dataset.names.cameras and dataset.drawn is None
    assert browse.read(dataset, dataset.keys[0]).images is None
