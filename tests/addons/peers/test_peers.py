"""Exports opened by those that they are for, in an environment of their own.

STARJAX_PEERS names its Python; a peer that is not installed there is skipped:
`python -m venv peers && peers/bin/pip install lerobot robomimic 'zarr<3'`.
"""

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
import recorded

from starjax.addons.formats import base, exchange, foreign, own_columns

PYTHON = os.environ.get("STARJAX_PEERS", "")
PACKAGE = {"lerobot": "lerobot", "robomimic": "robomimic", "zarr": "zarr"}


def there(package):
    found = [PYTHON, "-c", f"import {package}"]
    return bool(PYTHON) and subprocess.run(found, capture_output=True).returncode == 0


@pytest.mark.parametrize(
    ("name", "video"), [("lerobot", True), ("lerobot", False), ("robomimic", True), ("zarr", True)]
)
def test_the_peer_reads_what_we_wrote(tmp_path, name, video):
    if not there(PACKAGE[name]):
        pytest.skip(f"STARJAX_PEERS has no {PACKAGE[name]}")
    recorded.write(tmp_path / "d", size=32)
    form = base.FORMATS.get(name)
    out = tmp_path / ("out.hdf5" if name == "robomimic" else "out")
    source = exchange.source(tmp_path / "d", form)
    exchange.export(source, out, form, video)
    script = Path(__file__).with_name(f"read_{name}.py")
    done = subprocess.run([PYTHON, script, out], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    print(done.stdout)
    said = json.loads(done.stdout.splitlines()[-1])
    first, last = (source.read(i, source.columns) for i in (0, 3))
    assert (said["episodes"], said["frames"]) == (4, 120)
    action, state, image = map(form.named, ("action", "state", "image_camera"))
    np.testing.assert_array_equal(np.float32(said["action"]), first[action][0])
    np.testing.assert_array_equal(np.float32(said["state"]), last[state][-1])
    mean = said["mean"][image] * 255 if name == "lerobot" else said["mean"]
    assert abs(mean - last[image][-1].mean()) < (2.0 if video else 1e-3)


def edit(*words):
    """Runs LeRobot's own editor of datasets."""
    tool = Path(PYTHON).with_name("lerobot-edit-dataset")
    options = [f"--{name}={value}" for name, value in words]
    done = subprocess.run([tool, *options], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.parametrize("video", [True, False])
def test_what_lerobots_editor_leaves_is_read_by_our_columns(tmp_path, video):
    """Deletes an episode, splits the rest, merges the parts: columns and pictures as exported."""
    if not there("lerobot") or not Path(PYTHON).with_name("lerobot-edit-dataset").exists():
        pytest.skip("STARJAX_PEERS has no lerobot-edit-dataset")
    recorded.write(tmp_path / "d", size=64)
    form = base.FORMATS.get("lerobot")
    source = exchange.source(tmp_path / "d", form)
    exchange.export(source, tmp_path / "whole", form, video)
    kind = "operation.type"
    edit(
        ("repo_id", "me/whole"), ("root", tmp_path / "whole"), ("new_repo_id", "me/cut"),
        ("new_root", tmp_path / "cut"), (kind, "delete_episodes"),
        ("operation.episode_indices", "[1]"),
    )  # fmt: skip
    splits = '{"a": [0, 1], "b": [2]}'
    edit(
        ("repo_id", "me/cut"), ("root", tmp_path / "cut"), ("new_root", tmp_path / "parts"),
        (kind, "split"), ("operation.splits", splits),
    )  # fmt: skip
    parts = [str(tmp_path / "parts" / name) for name in "ba"]
    edit(
        ("new_repo_id", "me/merged"), ("new_root", tmp_path / "merged"), (kind, "merge"),
        ("operation.repo_ids", "['me/b', 'me/a']"), ("operation.roots", str(parts)),
    )  # fmt: skip
    for name, kept in {"cut": [0, 2, 3], "parts/a": [0, 2], "merged": [3, 0, 2]}.items():
        with base.open_dataset(tmp_path / name, "lerobot") as edited:
            found = foreign.import_mapped(
                edited, own_columns.mapping(edited), tmp_path / f"{name}.back", tmp_path
            )
            assert (found.episodes, found.left_out, found.notes) == (len(kept), 0, [])
            for i, episode in enumerate(kept):
                before = source.read(episode, source.columns)
                after = edited.read(i, source.columns)
                for column, array in before.items():
                    off = np.abs(after[column].reshape(array.shape) - np.float64(array)).mean()
                    is_video = video and source.columns[column].is_image  # encoded twice
                    assert off <= (3.0 if is_video else 0.0)
