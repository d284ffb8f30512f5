"""The page of a recording: its figures are the motion's, and any dataset has one."""

import io

import numpy as np
import pytest
import recorded

from starjax.addons.viewer import dataset_page, recording_figures, recording_page
from starjax.data import recordings

HZ = 30.0


def recording(moves=0.0, bend=0.0, seconds=20.0, number=0):
    """A straight tool whose trocar moves along x, and whose shaft may miss it."""
    steps = int(seconds * HZ)
    times = np.arange(steps) / HZ
    trocar = np.array([0.1, 0.2, 0.3]) + np.outer(moves * times / seconds, [1.0, 0.0, 0.0])
    tilt = np.stack([0.4 * np.sin(times), 0.4 * np.cos(0.7 * times), -np.ones(steps)], -1)
    z = tilt / np.linalg.norm(tilt, axis=-1, keepdims=True)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    R = np.stack([x, np.cross(z, x), z], -1)
    tips = trocar + 0.1 * z + bend * x
    jaws = np.where(times % 4.0 < 2.0, 1.0, -1.0)
    return recordings.EpisodeMotion(
        number,
        HZ,
        R[:, None],
        tips[:, None],
        tips[:, None],
        jaws[:, None],
        trocar.mean(0)[None],
        True,
        "train",
    )


def test_figures_are_the_motions():
    found = recordings.figures(recording(), 0)
    np.testing.assert_allclose(found.depth_mm, 100.0, atol=1e-6)
    assert found.rcm_mm.max() < 1e-6 and found.wander_mm.max() < 0.01
    assert found.closings == 5
    assert recordings.figures(recording(bend=0.002), 0).rcm_mm == pytest.approx(2.0, abs=1e-6)


def test_the_shaft_of_a_wrist_counts_and_its_angles_are_shown(tmp_path):
    recorded.write(tmp_path / "wrist", wrist=True)
    (first, *_) = recordings.of_dataset(tmp_path / "wrist")
    found = recordings.figures(first, 0)
    assert found.rcm_mm.max() < 1e-3
    folder = tmp_path / "wrist/episodes/0000-0000-0"
    angles = np.rad2deg(np.load(folder / "wrist.npy")[:, 0])
    np.testing.assert_allclose(found.bend_deg, angles, atol=1e-3)
    cards = recording_page.cards([first], [[found]])
    assert "Wrist" in {card.name for card in cards}
    straight = recordings.figures(recording(), 0)
    assert straight.bend_deg is None


def test_a_trocar_that_moves_wanders():
    """By 6 mm in 20 s: the middles of windows of 5 s are up to 2.25 mm from the mean.

    An estimate from a trocar that moves within its window is off by some tenths of a mm.
    """
    found = recordings.figures(recording(moves=0.006), 0)
    assert found.wander_mm.max() == pytest.approx(2.25, abs=0.7)
    assert found.rcm_mm.max() == pytest.approx(3.0, abs=0.3)


def test_the_page_shows_the_anomalies_and_escapes_them():
    text = recording_page.render(
        "<b>mine</b>", [("dataset", "x"), ("  a", "float32")], [recording()], ["<script>odd"]
    )
    assert "<script>odd" not in text and "&lt;script&gt;odd" in text
    assert "&lt;b&gt;mine" in text and text.count("data:image/png") == 6
    assert "http" not in text  # nothing is fetched


def test_the_page_shows_images_of_every_camera_side_by_side():
    import matplotlib.image

    images = np.random.default_rng(0).integers(0, 256, (3, 8, 8, 3), np.uint8)
    png = recording_figures.strip(images)
    seen = matplotlib.image.imread(io.BytesIO(png), format="png")[..., :3]
    np.testing.assert_array_equal(np.round(255 * seen), np.concatenate(list(images), axis=1))
    text = recording_page.render("mine", [], [recording()], [], {"lens": images})
    assert text.count("data:image/png") == 7 and "lens" in text


def test_a_dataset_has_a_page(tmp_path):
    recorded.write(tmp_path / "ours")
    page = tmp_path / "page.html"
    dataset_page.write(tmp_path / "ours", "", page, [("dataset", "ours")], [])
    assert "data:image/png" in page.read_text()
