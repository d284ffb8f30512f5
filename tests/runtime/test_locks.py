"""One process holds a folder, also where the file system has no locks; a kill lets go of it."""

import errno
import fcntl
import os
import subprocess
import sys

import pytest

from starjax.runtime import files, locks

NO_LOCKS = ["ENOSYS", "ENOLCK", "EOPNOTSUPP", "EBADF"]
SYSTEMS = "the system's"

_HOLD = """
import errno, fcntl, pathlib, sys

def refuse(*args):
    raise OSError(getattr(errno, sys.argv[2]), "flock")

if hasattr(errno, sys.argv[2]):
    fcntl.flock = refuse
from starjax.runtime import files
with files.lock(pathlib.Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def without_locks(monkeypatch, name):
    """A file system whose flock fails with this error."""

    def refuse(*_):
        raise OSError(getattr(errno, name), "flock")

    if name != SYSTEMS:
        monkeypatch.setattr(fcntl, "flock", refuse)


@pytest.fixture(params=[SYSTEMS, *NO_LOCKS])
def kind(request, monkeypatch):
    without_locks(monkeypatch, request.param)
    return request.param


@pytest.fixture
def holder(tmp_path, kind):
    """Another process that holds `tmp_path`."""
    process = subprocess.Popen(
        [sys.executable, "-c", _HOLD, str(tmp_path), kind],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )
    with process:
        assert process.stdout and process.stdout.readline() == b"held\n"
        yield process
        process.kill()


def hold(directory):
    with files.lock(directory):
        pass


def test_a_second_run_is_refused_until_the_first_is_killed(tmp_path, holder):
    with pytest.raises(files.StorageError, match=f"in use by process {holder.pid} on "):
        hold(tmp_path)
    holder.kill()
    holder.wait()
    hold(tmp_path)


def test_a_run_that_ends_lets_go(tmp_path, kind):
    hold(tmp_path)
    with locks.hold(tmp_path / ".lock") as is_systems:
        assert is_systems == (kind == SYSTEMS)
        with pytest.raises(files.StorageError, match=f"in use by process {os.getpid()} on "):
            hold(tmp_path)
    hold(tmp_path)


def test_a_marker_of_a_killed_process_elsewhere_says_how_to_go_on(tmp_path, monkeypatch):
    without_locks(monkeypatch, "ENOLCK")
    marker = tmp_path / ".lock-marker"
    with locks.hold(tmp_path / ".lock"):
        content = marker.read_text()
    marker.write_text(content.replace(content.split()[1], "another-machine"))
    with pytest.raises(files.StorageError, match=f"remove {marker}"):
        hold(tmp_path)
    marker.unlink()
    hold(tmp_path)


def test_where_neither_lock_works_a_line_says_so(tmp_path, monkeypatch):
    without_locks(monkeypatch, "EIO")
    with pytest.raises(files.StorageError, match="another disk"):
        hold(tmp_path)
