"""The page and tables.md of committed results, golden; and what must hold of any page.

After a change of what they say: STARJAX_GOLDEN=write pytest tests/report/test_page.py
"""

import json
import os
import pathlib
import re

import pytest
from report.conftest import edited

from starjax.report import (
    build,
    captions,
    figures,
    outcomes,
    page,
    results,
    sections,
    stats,
    tables,
)
from starjax.runtime import files

GOLDEN = pathlib.Path(__file__).parents[1] / "golden"


@pytest.fixture(scope="module")
def kept(pytestconfig):
    """Results of all methods with their sweeps, and one alone of schema 1, which stays."""
    folder = pytestconfig.rootpath / "experiments"
    paths = {
        "several": [file.parent for file in sorted(folder.glob("all_methods/*/result.json"))],
        "one": [GOLDEN / "result_schema_1" / "result.json"],
    }
    return {
        name: build._named_apart(sorted(map(results.load, found), key=build._order))
        for name, found in paths.items()
    }


@pytest.mark.parametrize("name", ["several", "one"])
def test_page_and_tables_are_the_golden_ones(kept, name):
    runs = kept[name]
    drawn = {"md": tables.markdown(runs), "html": page.render(runs, runs[-1], {}, None)}
    for ending, text in drawn.items():
        golden = GOLDEN / f"report_{name}.{ending}"
        if os.environ.get("STARJAX_GOLDEN") == "write":
            golden.write_text(text)
        assert text == golden.read_text(), golden.name


def test_both_schemas_draw_the_same(kept, tmp_path):
    (old,) = kept["one"]
    trials = [
        {name: value for name, value in trial._asdict().items() if value is not None}
        for trial in old.trials
    ]
    new = {"schema": 2, "scene": old.result.scene._asdict(), "control_hz": 30.0, "per_trocar": []}
    content = json.loads(old.path.read_text()) | new | {"trials": trials}
    files.write_json(tmp_path / "result.json", content)
    run = results.load(tmp_path)
    assert (old.result.schema, run.result.schema) == (1, 2)
    assert tables.markdown([run]) == tables.markdown([old])
    assert page.render([run], run, {}, None) == page.render([old], old, {}, None)


def test_the_page_stands_alone_and_escapes_what_it_shows(several):
    run = edited(several[0], about={"command": "run --out '<b>&'", "warnings": ["<i>"]})
    runs = [run, *several[1:]]
    text = page.render(runs, runs[-1], {"fig4": (b"light", b"dark")}, b"mp4")
    assert "<script" not in text and "http" not in text
    urls = re.findall(r'(?:src|href|srcset)="([^"]*)"', text)
    assert len(urls) == 3 and all(url.startswith("data:") for url in urls)
    assert "&lt;b&gt;&amp;" in text and "&lt;i&gt;" in text and "<b>&" not in text


def test_a_stage_that_did_not_run_leaves_no_trace(one):
    run = edited(one, [], about=dict.fromkeys(one.result.about), config={}, figures={})
    text = page.render([run], run, {}, None)
    assert "<h2>" not in text and "None" not in text and "<video" not in text
    assert tables.markdown([run]).count("|") == 0
    assert figures.training([run._replace(curves=[])]) is None


@pytest.mark.parametrize(
    ("seen", "unseen", "said"),
    [(45, 15, "60.0"), (15, 45, "60.0"), (44, 36, "0.2"), (25, 24, "chance"), (25, 25, "as well")],
)
def test_the_verdict_says_what_is_sure_of_the_gap(one, seen, unseen, said):
    trials = [
        one.trials[0]._replace(seen=part, success=i < count, trial=i)
        for part, count in ((True, seen), (False, unseen))
        for i in range(50)
    ]
    run = edited(one, trials)
    text = captions.verdict([run], run)
    assert said in text and text.index(f"{seen} of 50") < text.rindex(f"{unseen} of 50")
    _, low, high = stats.gap(*map(outcomes.tally, outcomes.split(trials)))
    assert ("new trocar costs" in text, "better" in text) == (low > 0, high < 0)


def test_notes_name_the_runs_that_they_are_about(one):
    usual = captions.notes([one, one])
    policy = {**one.result.config["policy"], "sees_trocar": "never"}
    cases = {
        "its own": edited(one, about={"warnings": [*one.result.about["warnings"], "its own"]}),
        "4, 60": edited(one, time_limit_s=4.0),
        "policy.sees_trocar": edited(one, config={**one.result.config, "policy": policy}),
        "sweep.json and bench.json": one._replace(others=("sweep.json", "bench.json")),
        "ends of control steps": edited(one, figures={"rcm_error_mm": {"executed": {"max": 1.0}}}),
    }
    for said, run in cases.items():
        (note,) = set(captions.notes([one, run._replace(label="this one")])) - set(usual)
        assert said in note


def test_what_differs_between_runs_is_a_fact_of_each(one):
    seed = one.result.config["seed"]
    assert "Seed of the trials" not in sections.facts([edited(one, seed=seed)])
    runs = [edited(one, seed=seed + i, commit="0123456789abcdef", dirty=True) for i in (0, 1)]
    text = sections.facts(runs)
    assert f"<dt>Seed of the trials</dt><dd>{seed}; {seed + 1}</dd>" in text
    assert "0123456789, with local changes" in text and "fr5 with grasper" in text
