"""Names of the Hub: the fetched file, and each mistake in one line. The library is a fake."""

import pathlib
import shutil
import sys
import types

import mistakes
import pytest
import recorded

from starjax.cli import inspect_command
from starjax.policies import packaged
from starjax.runtime import hub


@pytest.fixture
def repositories(tmp_path, monkeypatch):
    """Makes a folder of repositories, `model/user/repo` and `dataset/user/repo`."""
    asked = []

    def snapshot_download(repo, *, repo_type, revision, allow_patterns=None):
        asked.append((repo_type, repo, revision, *(allow_patterns or ())))
        if not (path := tmp_path / repo_type / repo).exists():
            raise OSError(f"404 Client Error\x1b[2J\nRepository Not Found for {repo}")
        return str(path)

    def hf_hub_download(repo, filename, **given):
        path = pathlib.Path(snapshot_download(repo, **given)) / filename
        if not path.exists():
            raise OSError("Entry Not Found")
        return str(path)

    fake = types.ModuleType("huggingface_hub")
    fake.snapshot_download, fake.hf_hub_download = snapshot_download, hf_hub_download
    fake.__spec__ = types.SimpleNamespace(name="huggingface_hub")
    monkeypatch.setitem(sys.modules, "huggingface_hub", fake)
    return tmp_path, asked


def test_a_policy_is_its_file(repositories):
    folder, asked = repositories
    repo = folder / "model" / "me" / "compact"
    repo.mkdir(parents=True)
    shutil.copy(packaged.locate("compact"), repo / "policy.safetensors")
    shutil.copy(packaged.locate("compact"), repo / "other.safetensors")
    assert packaged.find("--policy", "hf://me/compact") == repo / "policy.safetensors"
    found = packaged.find("--policy", "hf://me/compact@v1.0/other.safetensors")
    assert found == repo / "other.safetensors"
    assert asked == [("model", "me/compact", None), ("model", "me/compact", "v1.0")]
    assert "stardiff" in inspect_command.inspect("hf://me/compact").rows[0][1]


def test_a_dataset_is_its_folder(repositories):
    folder, asked = repositories
    ours = folder / "dataset" / "me" / "ours"
    ours.parent.mkdir(parents=True)
    recorded.write(ours)
    assert hub.dataset("PATH", "hf://datasets/me/ours") == ours
    assert asked == [("dataset", "me/ours", None)]
    assert "schema" in inspect_command.inspect("hf://datasets/me/ours").rows[0][1]


@pytest.mark.parametrize(
    "name", ["hf://me", "hf://me/repo/../../key", "hf:///etc/passwd", "hf://me/re po", "hf://"]
)
def test_another_form_of_name_asks_nothing(repositories, name):
    with mistakes.of("--policy", name):
        packaged.find("--policy", name)
    assert not repositories[1]


def test_what_the_library_raises_is_one_line(repositories):
    with mistakes.of("--policy", "404") as caught:
        packaged.find("--policy", "hf://me/nothing")
    assert str(caught.value).isprintable()
    with mistakes.of("PATH", "404"):
        hub.dataset("PATH", "hf://datasets/me/nothing")


def test_without_the_library_the_extra_is_named(monkeypatch):
    monkeypatch.setattr(hub.importlib.util, "find_spec", lambda name: None)
    with mistakes.of("--policy") as caught:
        packaged.find("--policy", "hf://me/compact")
    assert "hub" in caught.value.hint


@pytest.mark.parametrize(
    ("name", "revision", "file"),
    [
        ("hf://u/r@refs/pr/3", "refs/pr/3", ""),
        ("hf://datasets/u/r@refs/pr/3/data/a.h5", "refs/pr/3", "data/a.h5"),
        ("hf://u/r@refs/convert/parquet/a", "refs/convert/parquet", "a"),
        ("hf://u/r@feature%2Fx/dir/", "feature/x", "dir"),
        ("hf://u/r@refs%2Fpr%2F12/f", "refs/pr/12", "f"),
        ("hf://u/r@v1.0/refs/pr/3", "v1.0", "refs/pr/3"),
        ("hf://u/r/a/b", "", "a/b"),
    ],
)
def test_a_revision_may_be_a_pull_request_or_have_slashes(name, revision, file):
    found = hub.parse("PATH", name)
    assert (found.repo, found.revision, found.file) == ("u/r", revision, file)


def test_of_a_dataset_only_the_named_part_is_downloaded(repositories):
    folder, asked = repositories
    (folder / "dataset/me/many/part[1]").mkdir(parents=True)
    assert hub.dataset("PATH", "hf://me/many/part[1]").name == "part[1]"
    hub.dataset("PATH", "hf://me/many")
    assert asked == [
        ("dataset", "me/many", None, "part[[]1]", "part[[]1]/*"),
        ("dataset", "me/many", None),
    ]
    with mistakes.of("PATH", "hf://me/many/other"):
        hub.dataset("PATH", "hf://me/many/other")
