"""`starjax inspect --page` of others' datasets."""

import json

import mistakes
import openh

from starjax.addons.viewer import dataset_page
from starjax.cli import inspect_command


def test_a_dataset_of_others_has_a_page(tmp_path):
    openh.write(tmp_path / "theirs", "tud-ur5e")
    about = inspect_command.inspect(str(tmp_path / "theirs"))  # integers among its columns
    page = tmp_path / "page.html"
    odd = dataset_page.write(tmp_path / "theirs", "", page, about.rows, about.odd)
    assert len(odd) == 1 and "depth" in odd[0] and page.read_text().count("data:image/png") == 6


def test_a_dataset_that_no_mapping_fits_has_none(tmp_path):
    openh.write(tmp_path / "other", "tud-ur5e")
    info = tmp_path / "other/meta/info.json"
    about = json.loads(info.read_text())
    del about["features"]["action"]
    info.write_text(json.dumps(about))
    with mistakes.of("--map", "none"):
        dataset_page.write(tmp_path / "other", "", tmp_path / "page.html", [], [])
