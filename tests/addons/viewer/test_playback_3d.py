"""Rollouts in 3D: content of the file, and its frame in the page."""

import base64
import html
import re

import msgspec
import numpy as np
import pytest
import synthetic
import zstandard

from starjax.addons.viewer import playback, playback_3d
from starjax.report import page, results, video
from starjax.sim import scene


@pytest.fixture(scope="module")
def one(tmp_path_factory):
    """STAR-Diff of a run that was made up."""
    return results.load(synthetic.run(tmp_path_factory.mktemp("one"), skill=(0.95, 0.8), seed=2))


@pytest.fixture(scope="module")
def recorded(one):
    """Two of the runs' rollouts, with joint positions of their scene."""
    nq = scene.compose(one.result.scene).nq
    kept = [
        r._replace(qpos=np.tile(np.linspace(0, 0.5, len(r.p_world_tip))[:, None], nq))
        for r in one.rollouts
    ]
    return one._replace(rollouts=kept)


@pytest.fixture(scope="module")
def solid(recorded):
    return playback_3d.record([recorded])


def content(text):
    """The recording in a page: (seconds, [(second, message)])."""
    data = base64.b64decode(re.search(r'__VISER_EMBED_DATA__="([^"]+)"', text)[1])
    inner = zstandard.ZstdDecompressor().decompressobj().decompress(data[8:])
    length = int.from_bytes(inner[:8], "little")
    found = msgspec.msgpack.decode(inner[8 : 8 + length])
    return found["durationSeconds"], found["messages"]


def test_it_plays_in_real_time_and_stays_small(recorded, solid):
    seconds, messages = content(solid.html)
    shown = video.choose([recorded])
    steps = max(len(one.rollout.p_world_tip) for one in (shown[0], shown[-1]))
    assert seconds - 1.0 == pytest.approx(min(12.0, steps / recorded.result.control_hz), abs=0.07)
    named = {message["name"] for _, message in messages if "name" in message}
    assert {"/rollout0/geoms/cylinder", "/rollout1/geoms/cylinder"} <= named
    times = [second for second, _ in messages]
    assert times == sorted(times) and len(solid.html) < 3e6


def test_the_page_holds_it_in_a_frame_that_reaches_nothing_else(one, solid):
    text = page.render([one], one, {}, None, solid)
    frame = re.search(r'<iframe [^>]*sandbox="allow-scripts"[^>]* srcdoc="([^"]*)"', text)
    assert frame and html.unescape(frame[1]) == solid.html
    assert "<script" not in text  # except the frame's
    assert "<iframe" not in page.render([one], one, {}, None)


def test_bodies_at_rest_are_where_the_trial_has_them(recorded, monkeypatch):
    (clip, *_) = video.choose([recorded])
    names = scene.name("needle_drive")
    nq, marks = scene.compose(names).nq, []
    rollout = clip.rollout._replace(qpos=np.zeros((len(clip.rollout.p_world_tip), nq)))
    result = clip.result._replace(scene=names)
    monkeypatch.setattr(
        video, "choose", lambda runs: [clip._replace(result=result, rollout=rollout)]
    )
    monkeypatch.setattr(
        playback, "html", lambda model, rollouts, *rest: marks.append(rollouts[0][0].still) or ""
    )
    playback_3d.record([recorded])
    entry, leaves = marks[0].p
    assert 0.007 < np.linalg.norm(entry - leaves) < 0.015


def test_nothing_is_drawn_without_joint_positions(one):
    assert playback_3d.record([one]) is None
