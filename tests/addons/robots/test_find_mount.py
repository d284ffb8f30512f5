"""`starjax find-mount`: its search, output and refusals."""

import mistakes
import numpy as np
import pytest

from starjax.addons.robots import find_mount as command
from starjax.addons.robots import mount_search
from starjax.sim import mounts
from starjax.sim.arms.base import Mount

MOUNT = Mount((0.1, 0.2, 0.3), 1.0, 2.0, (0.0, 0.5), tilt=0.5)
GOOD = mounts.Fit(*np.array([1e-7, 0.25, 0.08, 0.1]))


@pytest.fixture
def searched(monkeypatch):
    """What was searched for; the search finds MOUNT, with GOOD."""
    asked = []

    def search(at, workspace, seed, tilts, tell):
        asked.append((workspace, seed, tilts))
        tell(GOOD)
        return MOUNT, GOOD

    monkeypatch.setattr(mount_search, "search", search)
    return asked


def test_a_mount_is_printed_as_a_row_of_the_record(searched, capsys):
    assert command.main(["fr5", "grasper", "board", "--seed", "3", "--tilts"]) == 0
    assert searched[0][1:] == (3, True)
    said = capsys.readouterr().out
    row = said[said.index("(", said.index("#")) :].strip().rstrip(",")
    key, _, mount = row.partition(": ")
    assert key == '("grasper", "board")' and eval(mount, {"Mount": Mount}) == MOUNT
    assert "0.250" in said and "0.080" in said


def test_a_task_stands_for_the_workspaces_of_its_arms(searched):
    command.main(["fr5", "grasper", "peg_transfer_bimanual"])
    left, right = (workspace for workspace, _, _ in searched)
    assert abs(right.roll_zero - left.roll_zero) == pytest.approx(np.pi)


def test_a_mount_that_is_none_is_a_failure(monkeypatch):
    bad = GOOD._replace(margin=np.float64(0.05))
    monkeypatch.setattr(mount_search, "search", lambda *_: (MOUNT, bad))
    assert command.main(["fr5", "grasper", "board"]) == 1


@pytest.mark.parametrize(
    ("argv", "argument"),
    [
        (["fr6", "grasper", "board"], "arm"),
        (["fr5", "hook", "board"], "tool"),
        (["fr5", "grasper", "bord"], "WORKSPACE"),
    ],
)
def test_unknown_names_are_refused(argv, argument):
    with mistakes.of(argument, next(word for word in argv if word in ("fr6", "hook", "bord"))):
        command.main(argv)
