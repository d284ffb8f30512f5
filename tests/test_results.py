"""What is printed of results is what the results say, and nothing in experiments/ is left over."""

import json
import re
import tomllib

import pytest

from starjax.evaluation import trial_file


@pytest.fixture(scope="module")
def tables(pytestconfig):
    with pytest.MonkeyPatch.context() as patch:
        for folder in ("experiments", "benchmarks"):
            patch.syspath_prepend(pytestconfig.rootpath / folder)
        import tables

        yield tables


@pytest.fixture(scope="module")
def pages(tables):
    return list(tables.pages())


def test_every_page_is_drawn_from_results(pages):
    """If this fails: python experiments/tables.py."""
    for page, text in pages:
        assert page.read_text() == text, page


def test_a_number_that_is_not_in_a_result_is_seen(tables):
    marked = [tables.ROOT / page for page in ("README.md", "docs/explanation/speed.md")]
    text = "\n".join(page.read_text() for page in marked)
    drawn = [match.span() for match in tables._BLOCK.finditer(text)]
    assert len(drawn) == 2
    for start, end in drawn:
        at = start + re.search(r"\d", text[start:end].partition("-->")[2]).start()
        at += text[start:end].index("-->") + 3
        changed = text[:at] + str((int(text[at]) + 1) % 10) + text[at + 1 :]
        assert tables.redraw(changed, tables.table) == text != changed
    with pytest.raises(KeyError):
        tables.table("all_methods/other")


def test_counts_in_a_result_are_those_of_its_trials(tables):
    for file in tables.HERE.rglob("*.json"):
        found = trial_file.read(file)
        parts = {"all": found["trials"]}
        if file.name != "sweep.json":
            for name, seen in (("seen", True), ("unseen", False)):
                parts[name] = [trial for trial in found["trials"] if trial["seen"] is seen]
        for test, key in (("strict", "success"), ("loose", "loose"), ("safe", "safe")):
            for part, trials in parts.items():
                said = found[test] if file.name == "sweep.json" else found[test][part]
                counts = (sum(trial[key] for trial in trials), len(trials))
                assert (said["successes"], said["trials"]) == counts, (file, test, part)


def test_every_result_belongs_to_a_claim(tables):
    used = set()
    for folder in tables.claims.folders():
        said = tomllib.loads((folder / "claim.toml").read_text())
        files = [folder / file for file in said["runs"].values()]
        used |= {file.resolve() for file in files}
        used |= {file.with_name("sweep.json").resolve() for file in files}
    used |= set((tables.HERE / "goals").glob("*.json"))  # of the page of goals, without a claim
    kept = {file.resolve() for file in tables.HERE.rglob("*.json")}
    assert kept <= used
    for file in tables.HERE.rglob("*.trials.npz"):
        result = file.with_name(file.name.replace(".trials.npz", ".json"))
        assert json.loads(result.read_text())["trials"] == file.name


def test_what_a_page_links_to_is_there(tables, pages):
    """Those of docs/ are looked at in tests/docs: some lead to pages made with the site."""
    for page, text in pages:
        if page.is_relative_to(tables.ROOT / "docs"):
            continue
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text):
            assert (page.parent / target).exists(), (page, target)


def test_a_goal_is_met_where_no_figure_misses_its_bound(tables):
    half, most = {"rate": 0.5, "successes": 1, "trials": 2}, {"rate": 0.9}
    met = tables.goals_list._met
    assert met({"least": [50, 90]}, [half, most]) == "yes"
    assert met({"least": [95]}, [half, most]) == "missed by 45 and 5 points"
    assert met({"most": [0.1]}, [0.1, 0.3]) == "missed by 0.2"
    assert met({}, []) == "not measured" and met({"test": "tests"}, []) == "yes"


def test_the_sixths_of_the_dial_hold_every_trial(tables):
    columns, turns = tables.claims.columns, range(len(tables.claims.columns.TURNS))
    for run in tables.claims.load(tables.HERE / "dial").runs.values():
        parts = {"seen": 400, "unseen": 200} | ({"trocars": 600} if run.swept else {})
        for part, count in parts.items():
            assert sum(columns.by_turn(run, part, turn).trials for turn in turns) == count
