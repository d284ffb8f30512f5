"""The tables and the page of committed results, and properties of any page.

To rewrite the golden tables: STARJAX_GOLDEN=write pytest tests/report/test_page.py
"""

import html
import os
import pathlib
import re
import shlex

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

GOLDEN = pathlib.Path(__file__).parents[1] / "golden"


@pytest.fixture(scope="module")
def kept(pytestconfig):
    """Results of all methods with their sweeps, and one alone."""
    folder = pytestconfig.rootpath / "experiments"
    paths = {
        "several": [
            file.parent for file in sorted(folder.glob("methods/small_networks/*/result.json"))
        ],
        "one": [GOLDEN / "result" / "result.json"],
    }
    return {
        name: build._named_apart(sorted(map(results.load, found), key=build._order))
        for name, found in paths.items()
    }


@pytest.mark.parametrize("name", ["several", "one"])
def test_tables_are_the_golden_ones(kept, name):
    text, golden = tables.markdown(kept[name]), GOLDEN / f"report_{name}.md"
    if os.environ.get("STARJAX_GOLDEN") == "write":
        golden.write_text(text)
    assert text == golden.read_text(), golden.name


def rows(text):
    """Tables of a page: lists of rows of cells' text; a bar's cell holds its label."""
    found = []
    for table in re.findall(r'<div class="scroll[^>]*><table>(.*?)</table></div>', text, re.DOTALL):
        cells = [re.findall(r"<t[hd]\b.*?</t[hd]>", row, re.DOTALL) for row in table.split("<tr>")]
        labelled = [
            [re.sub(r'<span[^>]*title="([^"]*)".*', r"\1", c) for c in row] for row in cells
        ]
        plain = [[html.unescape(re.sub(r"<[^>]*>", " ", c)).strip() for c in r] for r in labelled]
        found.append([row for row in plain if row])
    return found


def test_the_page_of_several_methods_has_the_numbers_of_tables(kept):
    runs = kept["several"]
    text = page.render(runs, runs[-1], {}, None)
    shown = rows(text)
    scores = {row[0]: row for row in shown[0] if len(row) == 6}
    for run in runs:
        seen, unseen = outcomes.rates(run.trials)
        row = scores[run.label]
        assert row[2].endswith(f"{seen.successes}/{seen.trials}")
        assert row[4].endswith(f"{unseen.successes}/{unseen.trials}")
        low, high = 100 * seen.low, 100 * seen.high
        assert row[1] == f"{100 * seen.rate:.1f}%, 95% interval {low:.1f} to {high:.1f}%"
    groups = [row[0] for row in shown[0] if len(row) == 1]
    assert groups == list(dict.fromkeys(run.group for run in runs))
    for table in (
        tables.paired(runs),
        tables.failures(runs),
        tables.rcm(runs),
        tables.phases(runs),
    ):
        assert table in shown
    (matrix,) = (t for t in shown if t[0] == ["Method", *map(str, range(12))])
    assert [row[0] for row in matrix[1:]] == [run.label for run in runs]
    own = outcomes.by_trocar(runs[0].trials)
    assert matrix[1][1:] == [
        f"{100 * outcomes.tally(group).rate:.0f}{'' if group[0].seen else '*'}" for group in own
    ]


def test_the_page_of_one_method_has_its_trocars_and_failures(kept):
    (run,) = kept["one"]
    text = page.render([run], run, {}, None)
    tests, trocars, *measured = rows(text)
    assert [row[0].split()[0] for row in tests[1:]] == ["Strict", "Loose", "Safe"]
    groups = outcomes.by_trocar(run.trials)
    assert [row[0] for row in trocars[1:]] == [str(group[0].trocar) for group in groups]
    for row, group in zip(trocars[1:], groups):
        won = sum(trial.success for trial in group)
        assert row[6].endswith(f"{won}/{len(group)}") and tuple(row[2:5]) == outcomes.place(
            group[0]
        )
    failed = outcomes.failures(run.trials)
    bars = re.findall(r'<div>([^<]*)</div><span class="unseen">.*?</i>(\d+)</span>', text)
    assert [int(count) for _, count in bars] == list(failed.values())
    assert tables.rcm([run]) in measured
    assert text.count('class="card"') == len(list(sections.cards(run))) >= 5


def test_the_page_stands_alone(several):
    text = page.render(several, several[-1], {"fig4": (b"light", b"dark")}, b"mp4")
    assert "<script" not in text and "http" not in text
    urls = re.findall(r'(?:src|href|srcset)="([^"]*)"', text)
    assert len(urls) == 3 and all(url.startswith("data:") for url in urls)


@pytest.mark.parametrize("count", [1, 3])
def test_no_text_of_a_result_is_markup(several, count):
    """Each text that a result's file can hold comes back as text, wherever the page shows it."""
    attack = "</pre><script>x</script>'\"&{{ 7 * 7 }}"
    about = {"command": attack, "warnings": [attack], "versions": {attack: attack}}
    about |= {"hardware": {"backend": "gpu", "devices": [attack], "cpu": attack, "cores": 2}}
    run = edited(several[-1], about=about, config={"preset": attack, "seed": 0, attack: attack})
    runs = [*several[: count - 1], run._replace(label=attack)]
    playback = page.Playback(attack, attack)
    text = page.render(runs, runs[-1], {}, None, playback)
    assert "<script" not in text and "49" not in re.sub(r"\d[\d.,/]*\d", "", text)
    shown = html.unescape(re.sub(r"<[^>]*>", "", text))
    assert shown.count(attack) >= 8


def test_a_stage_that_did_not_run_leaves_no_trace(one):
    run = edited(one, [], about=dict.fromkeys(one.result.about), config={}, figures={})
    text = page.render([run], run, {}, None)
    assert "<h2>" not in text and "None" not in text and "<video" not in text
    assert tables.markdown([run]).count("|") == 0
    assert figures.training([run._replace(curves=[])]) is None


@pytest.mark.parametrize(
    ("seen", "unseen", "said"),
    [(45, 15, "60.0"), (15, 45, "60.0"), (44, 36, "0.2"), (25, 24, "chance"), (50, 50, "as well")],
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


@pytest.mark.parametrize("counts", [(8, 4), (12, 12), (40, 40)])
def test_equal_rates_of_few_trials_are_not_said_to_be_alike(one, counts):
    trials = [
        one.trials[0]._replace(seen=part, success=i < count // 2, trial=i)
        for part, count in zip((True, False), counts)
        for i in range(count)
    ]
    run = edited(one, trials)
    text = captions.verdict([run], run)
    _, low, high = stats.gap(*map(outcomes.tally, outcomes.split(trials)))
    assert "as well" not in text and f"{100 * low:+.1f} to {100 * high:+.1f}" in text
    assert ("few trials" in text) == (high - low > 0.4)


def test_captions_name_what_is_drawn(one, several):
    assert "sweep" not in captions.distance([one], one)
    assert "sweep" in captions.distance(several, several[-1])
    assert "n is" in captions.distance([one], one) and "n is" not in captions.distance(several, one)
    errors = [line for line in one.curves if captions.HELD_OUT[0] in line]
    losses = [line for line in one.curves if captions.HELD_OUT[0] not in line]
    assert errors and "kept out" in captions.training([one])
    assert "kept out" not in captions.training([one._replace(curves=losses)])


def test_worst_and_percentile_of_a_card_are_of_one_measure(one):
    errors = {"executed": {"p99": 0.1, "max": 0.2}, "within_steps": {"p99": 0.3, "max": 0.9}}
    cards = sections.cards(edited(one, figures={**one.result.figures, "rcm_error_mm": errors}))
    (card,) = (card for card in cards if card.unit == " mm")
    assert card.value.startswith("0.1") and "0.2" in card.more and "0.9" not in card.more


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
    facts = sections.facts(runs)
    assert facts["Seed of the trials"] == f"{seed}; {seed + 1}"
    assert (facts["Code"], facts["Robot"]) == ("0123456789, with local changes", "fr5 with grasper")


def test_every_failed_trial_has_the_command_that_shows_it(several, tmp_path):
    run = several[0]
    lost = [trial for trial in run.trials if not trial.success]
    command = "starjax evaluate --policy 'my policy.safetensors' --arm panda"
    evaluated = edited(run, about={"command": command})
    head, *rows = sections.failed(evaluated)
    assert len(rows) == len(lost) > 10
    for row, trial in zip(rows, lost, strict=True):
        words = shlex.split(row[head.index("Command")])
        assert words[:6] == [
            "starjax",
            "view",
            "--policy",
            "my policy.safetensors",
            "--arm",
            "panda",
        ]
        flags = dict(zip(words[6::2], words[7::2], strict=True))
        assert flags == {
            "--seed": str(trial.seed),
            "--trocar": str(trial.trocar),
            "--trial": str(trial.trial),
        }
    text = html.unescape(page.render([evaluated], evaluated, {}, None))
    assert all(row[-1] in text for row in rows)
    (tmp_path / "config.json").write_text("{}")
    assert f"--run {tmp_path} " in sections.failed(evaluated._replace(path=tmp_path))[1][-1]
    served = edited(run, about={"command": "starjax evaluate --policy ws://here:8000"})
    assert sections.failed(served) == []
