"""The repository's address stands in one place, and badges show the metadata."""

import re
import shutil

import pytest


@pytest.fixture
def publish(pytestconfig, monkeypatch):
    monkeypatch.syspath_prepend(pytestconfig.rootpath / "docs")
    import publish

    return publish


def test_files_name_the_address_of_the_metadata(publish):
    slug = publish.slug(publish.address())
    for file in publish.FILES:
        named = re.findall(r"github(?:\.com)?/([\w-]+/[\w-]+)", (publish.ROOT / file).read_text())
        assert named and set(named) == {slug}, file


def test_badges_show_the_metadata(publish):
    for name, value in publish.badges().items():
        file = publish.ROOT / "docs" / "images" / f"badge_{name}.svg"
        assert value and file.read_text() == publish.draw(name, value)


def test_a_new_address_is_written_everywhere(publish, tmp_path, monkeypatch):
    (tmp_path / "docs" / "images").mkdir(parents=True)
    (tmp_path / "examples").mkdir()
    for file in publish.FILES:
        shutil.copy(publish.ROOT / file, tmp_path / file)
    old = publish.slug(publish.address())
    monkeypatch.setattr(publish, "ROOT", tmp_path)
    publish.main("https://github.com/someone/else")
    for file in publish.FILES:
        text = (tmp_path / file).read_text()
        assert "someone/else" in text and old not in text, file
    assert publish.address() == "https://github.com/someone/else"
