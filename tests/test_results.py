"""Printed results equal the files, and every file of experiments/ is used."""

import json
import re

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
    drawn = {page for page, _ in pages if page.name == "tables.md"}
    assert drawn == set(pages[0][0].parents[1].rglob("tables.md"))


def test_a_number_that_is_not_in_a_result_is_seen(tables):
    marked = [tables.ROOT / page for page in ("README.md", "docs/understand/method.md")]
    text = "\n".join(page.read_text() for page in marked)
    drawn = [match.span() for match in tables._BLOCK.finditer(text)]
    assert len(drawn) == 3
    for start, end in drawn:
        at = start + re.search(r"\d", text[start:end].partition("-->")[2]).start()
        at += text[start:end].index("-->") + 3
        changed = text[:at] + str((int(text[at]) + 1) % 10) + text[at + 1 :]
        assert tables.redraw(changed, tables.table) == text != changed
    with pytest.raises(KeyError):
        tables.table("methods/small_networks/other")


def test_counts_in_a_result_are_those_of_its_trials(tables):
    for file in set(tables.HERE.rglob("*.json")) - set(tables.HERE.rglob("stress.json")):
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


def test_counts_under_a_disturbance_are_those_of_its_failures(tables):
    for file in tables.HERE.rglob("stress.json"):
        for name, kind in json.loads(file.read_text())["disturbances"].items():
            for level, score in kind["levels"].items():
                failures = score["strict"]["trials"] - score["strict"]["successes"]
                assert failures == len(score["failed"]), (file, name, level)


def test_every_result_belongs_to_a_study(tables):
    used = set()
    for folder in tables.claims.folders():
        spec = tables.claims.load(folder).spec
        files = [folder / file for file in spec.get("runs", {}).values()]
        used |= {file.resolve() for file in files}
        beside = ("sweep.json", "stress.json")
        used |= {file.with_name(name).resolve() for file in files for name in beside}
    kept = {file.resolve() for file in tables.HERE.rglob("*.json")}
    assert kept <= used
    for file in tables.HERE.rglob("*.trials.npz"):
        result = file.with_name(file.name.replace(".trials.npz", ".json"))
        assert json.loads(result.read_text())["trials"] == file.name


def test_a_page_has_an_answer_a_picture_and_commands(tables):
    folders = {file.parent for file in tables.HERE.rglob("claim.toml")}
    assert set(tables.claims.folders()) == folders and len(tables.claims.pages()) <= 15
    for folder in tables.claims.pages():
        page = tables.claims.load(folder)
        assert len(tables.claims.filled(page, page.spec["answer"]).split()) <= 40, folder
        picture = folder / page.spec["picture"].get("file", tables.claims.PICTURE)
        assert picture.exists(), picture
        for name in page.spec.get("studies", [""]):
            commands = tables.claims.load(folder / name).spec["commands"]
            assert re.search("^(python|starjax|for|SEE|flags)", commands, re.MULTILINE), name


def test_pictures_are_drawn_from_the_results(tables):
    """If this fails: python experiments/pictures.py."""
    import pictures

    drawn = [tables.claims.load(folder) for folder in tables.claims.pages()]
    drawn = {page.folder: pictures.scores_of(page) for page in drawn}
    assert sum(map(bool, drawn.values())) >= 8
    for folder, scores in drawn.items():
        if scores:
            file = folder / tables.claims.PICTURE
            assert pictures.digest_of(file) == pictures.digest(scores), folder
    other = pictures.rates("| Method | seen |\n| --- | --- |\n| one | 3/4: 75% |")
    assert other["one"]["seen"].successes == 3 and pictures.digest(other) != pictures.digest(scores)


def test_counts_in_an_answer_are_those_of_the_run(tables):
    page = tables.claims.load(tables.HERE / "methods" / "small_networks")
    text = tables.claims.filled(page, "{STAR-Diff|unseen} trials: {STAR-Diff|unseen%}")
    counts = page.runs["STAR-Diff"].run.result.figures["strict"]["unseen"]
    assert text.startswith(f"{counts['successes']} of {counts['trials']} trials: ")
    assert text.endswith(f"{100 * counts['successes'] / counts['trials']:.1f}%")
    with pytest.raises(KeyError):
        tables.claims.filled(page, "{no such run|unseen}")


def test_what_a_page_links_to_is_there(tables, pages):
    """Those of docs/ are in tests/docs."""
    for page, text in pages:
        if page.is_relative_to(tables.ROOT / "docs"):
            continue
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text):
            assert (page.parent / target).exists(), (page, target)


def test_the_sixths_of_the_dial_hold_every_trial(tables):
    columns, turns = tables.claims.columns, range(len(tables.claims.columns.TURNS))
    for run in tables.claims.load(tables.HERE / "wrist" / "dial").runs.values():
        parts = {"seen": 400, "unseen": 200} | ({"trocars": 600} if run.swept else {})
        for part, count in parts.items():
            assert sum(columns.by_turn(run, part, turn).trials for turn in turns) == count
