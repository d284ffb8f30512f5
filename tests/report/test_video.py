"""The video: choice of rollouts, captions, and the file."""

import functools
import pathlib
import shutil
import subprocess
import sys
import types

import imageio_ffmpeg
import numpy as np
import pytest

from starjax.report import encode, scene_view, video
from starjax.sim import scene


def with_qpos(run):
    rollouts = [r._replace(qpos=np.zeros((len(r.p_world_tip), 2))) for r in run.rollouts]
    return run._replace(rollouts=rollouts)


def counting(qpos, trocars, labels, first, endoscope=None, still=None, size=64):
    """A camera that draws the number of the step."""
    steps = np.minimum(np.arange(first, first + scene_view.BATCH), len(qpos) - 1).astype(np.uint8)
    return np.broadcast_to(steps[:, None, None, None], (scene_view.BATCH, size, size, 3))


def test_the_video_shows_seen_and_unseen_whatever_their_outcome(one):
    def chosen(run):
        return [(x.rollout.trial.trocar, x.rollout.trial.trial) for x in video.choose([run])]

    run = with_qpos(one)
    assert [trocar < 8 for trocar, _ in chosen(run)] == [True, True, False, False]
    assert len(set(chosen(run))) == 4
    turned = [r._replace(trial=r.trial._replace(success=not r.trial.success)) for r in run.rollouts]
    assert chosen(run._replace(rollouts=turned)) == chosen(run)
    assert chosen(one) == []


def test_several_methods_are_shown_at_the_same_trial(several):
    runs = [with_qpos(run) for run in several]
    chosen = video.choose(runs)
    assert [shown.label for shown in chosen] == [run.label for run in several]
    (trial,) = {x.rollout.trial[:3] for x in chosen}
    assert trial[0] >= 8  # unseen
    other = [r._replace(trial=r.trial._replace(seed=4)) for r in runs[1].rollouts]
    shown = video.choose([runs[0], runs[1]._replace(rollouts=other), runs[2]])
    assert [x.label for x in shown] == [several[0].label, several[2].label]


@pytest.mark.parametrize("won", [True, False])
@pytest.mark.parametrize("steps", [3, 450])
def test_a_clip_says_what_it_shows_and_how_it_ended(one, monkeypatch, won, steps):
    said = []
    monkeypatch.setattr(video, "caption", lambda rows, w: said.append(rows) or np.zeros((2, w, 3)))
    trial = one.rollouts[0].trial._replace(success=won, trocar=5, seen=True)
    joints = {"p_world_tip": np.zeros((steps, 1, 3)), "qpos": np.zeros((steps, 2))}
    shown = video.Clip("m", one.result, one.rollouts[0]._replace(trial=trial, **joints))
    list(video._clip(functools.partial(counting, size=2), shown, ""))
    ((name, _), (ended, _)), ((about, _), (cut, _)) = said[-1]
    assert (name, about) == ("m", "seen trocar 5") and len(said) == min(steps, 360)
    assert ended.startswith("success") == won and ended.endswith(f", {steps / 30:.1f} s")
    assert cut == ("first 12 s shown" if steps == 450 else "")


def test_a_clip_that_ends_early_stays_as_it_ended(one):
    chosen = []
    for rollout, n in zip(one.rollouts, (5, 20)):
        short = rollout._replace(p_world_tip=rollout.p_world_tip[:n], qpos=np.zeros((n, 2)))
        chosen.append(video.Clip(str(n), one.result, short))
    images = list(video.frames(chosen, lambda names: counting))
    pixels = np.array([[image[-1, 0, 0], image[-1, -1, 0]] for image in images])
    assert len(images) == 20 + 45
    np.testing.assert_array_equal(pixels[:, 0], np.minimum(np.arange(65), 4))
    np.testing.assert_array_equal(pixels[:, 1], np.minimum(np.arange(65), 19))


@pytest.mark.slow
def test_the_camera_draws_the_recorded_configuration(one):
    model = scene.compose(one.result.scene)
    qpos, port = np.tile(model.qpos0, (3, 1)), np.array([[0.0, 0.0, 0.15]])
    draw = scene_view.camera(one.result.scene, 64)
    here = draw(qpos, port, {"source": 0, "target": 7}, 0)
    assert here.shape == (scene_view.BATCH, 64, 64, 3) and here.dtype == np.uint8
    moved = draw(qpos, port + np.array([0, 0.04, 0]), {"source": 0, "target": 7}, 0)
    assert (here[0] == here[2]).all() and (here[0] != moved[0]).any()
    assert (draw(qpos, port, {"source": 0, "target": 8}, 0)[0] != here[0]).any()


def test_a_goal_that_labels_do_not_tell_is_left_unmarked():
    task = types.SimpleNamespace(colours=lambda bound, layout, rgb: rgb + layout.target)
    assert scene.marked(task, None, {"target": 2}, 1) == 3 and scene.marked(task, None, {}, 1) == 1


@pytest.mark.parametrize("folder", ["a:1", "-x"])
def test_the_video_plays_everywhere_and_may_lie_in_any_folder(tmp_path, monkeypatch, folder):
    monkeypatch.chdir(tmp_path)
    pathlib.Path(folder).mkdir()
    ramp = (np.full((48, 64, 3), 8 * i, np.uint8) for i in range(30))
    encode.write(ramp, pathlib.Path(folder) / "ramp.mp4", 30.0)
    program = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(tmp_path / folder / "ramp.mp4")]
    said = subprocess.run(program, capture_output=True, text=True).stderr
    assert "h264" in said and "yuv420p" in said and "64x48" in said and "30 fps" in said
    raw = [*program, "-f", "rawvideo", "-pix_fmt", "rgb24", "-loglevel", "error", "-"]
    back = np.frombuffer(subprocess.run(raw, capture_output=True).stdout, np.uint8)
    means = back.reshape(30, 48, 64, 3).mean((1, 2, 3))
    np.testing.assert_allclose(means, 8 * np.arange(30), atol=3)


def test_an_encoder_that_fails_says_so_and_leaves_what_was_there(tmp_path, monkeypatch):
    clip, images = tmp_path / "clip.mp4", [np.zeros((8, 8, 3), np.uint8)] * 3
    clip.write_bytes(b"of before")
    for bad in (np.zeros((8, 8, 3)), np.zeros((7, 8, 3), np.uint8)):
        with pytest.raises(ValueError, match="images"):
            encode.write([bad], clip, 30.0)
    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: shutil.which("false"))
    with pytest.raises(OSError, match=r"clip\.mp4"):
        encode.write(images, clip, 30.0)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(RuntimeError, match="encoder"):
        encode.write(images, clip, 30.0)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"of before"]
