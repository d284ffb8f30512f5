"""The code that runs has a name, in a checkout or out of one, and asking for it never fails."""

import subprocess

import pytest

from starjax.runtime import provenance


def git(folder, *words):
    identity = ["-c", "user.name=n", "-c", "user.email=e"]
    command = ["git", "-C", str(folder), *identity, *words]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


@pytest.fixture
def checkout(tmp_path):
    package = tmp_path / "src" / "package"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (tmp_path / "README").write_text("")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-q", "-m", "first")
    return package


def test_a_checkout_names_its_commit_and_whether_the_package_was_changed(checkout):
    head = git(checkout, "rev-parse", "HEAD")
    assert provenance._of_checkout(checkout) == (head, False)
    (checkout.parents[1] / "README").write_text("other")
    (checkout / "new.py").write_text("")
    assert provenance._of_checkout(checkout) == (head, False)
    (checkout / "__init__.py").write_text("x = 1")
    assert provenance._of_checkout(checkout) == (head, True)


def test_a_package_inside_anothers_repository_is_not_its_commit(checkout):
    installed = checkout.parents[1] / "venv" / "package"
    installed.mkdir(parents=True)
    (installed / "__init__.py").write_text("")
    assert provenance._of_checkout(installed) is None


@pytest.mark.parametrize("error", [FileNotFoundError, subprocess.TimeoutExpired("git", 1)])
def test_without_git_the_installation_says_it(monkeypatch, error):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr(provenance.subprocess, "run", fail)
    provenance.code.cache_clear()
    try:
        found = provenance.code()
    finally:
        provenance.code.cache_clear()
    assert found.version
    assert (found.commit is None) == (found.dirty is None)


@pytest.mark.parametrize(
    ("version", "expected"),
    [
        ("0.1.0", None),
        ("0.2.dev3+g0a1b2c3", ("0a1b2c3", False)),
        ("0.2.dev3+g0a1b2c3.d20251125", ("0a1b2c3", True)),
    ],
)
def test_a_version_made_from_tags_names_a_commit(version, expected):
    assert provenance.of_version(version) == expected
