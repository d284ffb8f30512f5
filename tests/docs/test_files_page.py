"""The page of files names every field that is written."""

import json
import re

import synthetic

from starjax import cli
from starjax.evaluation import content


def named(pytestconfig, heading):
    """Words in backticks of the tables below a heading, to the next one of its level or above."""
    text = (pytestconfig.rootpath / "docs/reference/files.md").read_text()
    level = rf"#{{1,{len(heading.split()[0])}}}"
    section = re.split(rf"^{level} ", text.partition(f"{heading}\n")[2], flags=re.MULTILINE)[0]
    cells = [line.split("|")[1] for line in section.splitlines() if line.startswith("|")]
    return {word for cell in cells for word in re.findall(r"`([^`]+)`", cell)}


def test_every_key_of_a_result_is_described(pytestconfig, tmp_path):
    run = synthetic.run(tmp_path / "run", sweep_of=3)
    written = [pytestconfig.rootpath / "tests/golden/result/result.json"]
    written += [run / "result.json", run / "sweep.json"]
    keys = {key for file in written for key in json.loads(file.read_text())}
    assert keys - named(pytestconfig, "## result.json") == set()


def test_every_field_of_a_trial_is_described(pytestconfig):
    assert named(pytestconfig, "### A trial") == {"field", *content.Trial._fields} - {"field"}


def test_the_arms_alone_have_their_mounts(capsys):
    shown = []
    for words in (["list", "arms"], ["list"]):
        assert cli.dispatch(words) == 0
        shown.append(capsys.readouterr().out)
    alone, every = shown
    assert alone.startswith("arms") and "board" in alone and alone.count("\n\n") == 1
    arms = every.partition("arms (")[2].partition("tools (")[0].splitlines()
    assert max(map(len, arms)) < 80
