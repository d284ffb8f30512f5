"""Several processes make one dataset and one evaluation, the same to the byte as one does."""

import pathlib
import signal
import sys
import time

import jax
import kill
import numpy as np
import pytest
import several

from starjax.runtime import processes
from starjax.sim.rollouts import sharing

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import shared_job  # in this folder, for processes to run

SCRIPT = pathlib.Path(shared_job.__file__)


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    out = tmp_path_factory.mktemp("alone")
    shared_job.run(out)
    return out


def same(out, alone):
    for name in ("demos", "trials"):
        ours, theirs = kill.tree(out / name), kill.tree(alone / name)
        assert ours.keys() == theirs.keys() and ours == theirs
    tables = [np.load(path) for path in (*out.glob("table-*.npz"), alone / "table-0.npz")]
    for table in tables[1:]:
        for name in tables[0].files:
            np.testing.assert_array_equal(table[name], tables[0][name], name)
    return len(tables) - 1


def test_processes_that_share_do_what_one_does(tmp_path, alone):
    started = several.start(SCRIPT, str(tmp_path), "0", "-1")
    said = several.finish(started)
    assert [process.returncode for process in started] == [0, 0], said
    assert same(tmp_path, alone) == 2


@pytest.mark.parametrize(
    ("victim", "where"),
    [(0, "demos/episodes"), pytest.param(1, "trials", marks=pytest.mark.release)],
)
def test_a_killed_process_is_a_line_and_the_same_command_goes_on(tmp_path, alone, victim, where):
    started = several.start(SCRIPT, str(tmp_path), "0.2", "-1")
    end = time.monotonic() + 120
    while len(list((tmp_path / where).glob("[0-9c]*"))) < 2:
        assert time.monotonic() < end and all(process.poll() is None for process in started)
        time.sleep(0.02)
    started[victim].send_signal(signal.SIGKILL)
    said = several.finish(started)
    survivor = 1 - victim
    assert started[survivor].returncode != 0
    assert processes.LOST_HINT in said[0][1]
    started = several.start(SCRIPT, str(tmp_path), "0", "-1")
    said = several.finish(started)
    assert [process.returncode for process in started] == [0, 0], said
    assert same(tmp_path, alone) == 2


@pytest.mark.parametrize("failing", [0, pytest.param(1, marks=pytest.mark.release)])
def test_an_error_of_one_process_is_a_line_in_all(tmp_path, failing):
    started = several.start(SCRIPT, str(tmp_path), "0", str(failing))
    said = [error.splitlines() for _, error in several.finish(started)]
    assert [process.returncode for process in started] == [74, 74], said
    assert said[failing][-1].endswith(": no space left")
    assert f"process {failing} of 2 ended: no space left" in said[1 - failing][-1]


def test_processes_that_are_stopped_together_write_no_file_twice(tmp_path):
    shares = [sharing.Share(tmp_path, index, 2, "work") for index in (0, 1)]
    for share in shares:
        with pytest.raises(KeyboardInterrupt), sharing._told(share):
            raise KeyboardInterrupt("stopped")
    for share in shares:
        with pytest.raises(sharing.ProcessFailed, match=f"process {1 - share.index} of 2"):
            share.pause()


def test_one_process_leaves_no_signs(tmp_path):
    with sharing.shared(tmp_path) as share:
        assert share.mine([1, 2, 3]) == [1, 2, 3] and share.first("a", lambda: 7) == 7
        share.meet("b")
    assert {path.name for path in tmp_path.iterdir()} <= {".lock"}


def test_shares_are_all_parts_once(monkeypatch):
    monkeypatch.setattr(jax, "process_count", lambda: 3)
    shares = [sharing.Share(pathlib.Path(), index, 3, "x") for index in range(3)]
    parts = [part for share in shares for part in share.mine(range(10))]
    assert sorted(parts) == list(range(10))
