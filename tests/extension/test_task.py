"""A task from outside of starjax: the one of docs/howto/add-task.md, in a package of its own."""

import os
import pathlib
import subprocess
import sys

import pytest

from starjax.data import load
from starjax.evaluation import result

SITE = pathlib.Path(__file__).with_name("site")
FEW = [
    *("--demos.per-trocar", "1", "--demos.seen-trocars", "2"),
    *("--train.steps", "2", "--eval.trials", "1", "--eval.time-limit-s", "1"),
]


@pytest.mark.slow
def test_a_task_of_another_package_goes_from_its_expert_to_its_report(tmp_path):
    path = os.pathsep.join([str(SITE), *filter(None, sys.path)])
    command = ["starjax.experiments.run", "--task", "touch", "--preset", "smoke", *FEW]
    subprocess.run(
        [sys.executable, "-m", *command, "--out", str(tmp_path)],
        env={**os.environ, "PYTHONPATH": path},
        check=True,
    )
    (demos,) = tmp_path.glob("demos-*")
    assert load.load(demos).description["scene"]["task"] == "touch"
    found = result.read(tmp_path / "stardiff" / "result.json")
    assert found.scene.task == "touch" and len(found.trials) == 12
    assert "touched the mark" in (tmp_path / "report" / "index.html").read_text()
