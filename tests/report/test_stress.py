"""Disturbances as a table, around a circle, and on the page of their run."""

import json

import fakes
import numpy as np
import pytest
import synthetic

from starjax.report import page, results, stress, stress_page

FOUND = {
    "method": "stardiff",
    "disturbances": {
        name: {
            "what": "something",
            "unit": "mm",
            "levels": {
                level: {
                    "strict": {"successes": won, "trials": 10, "rate": won / 10},
                    "rcm_error_mm": {"executed": {"mean": error / 2, "p99": error}},
                    "wall_force_N": {"mean": error, "p99": error, "max": error},
                }
                for level, won, error in levels
            },
        }
        for name, levels in {
            "trocar_offset": [("0", 10, 0.01), ("5", 9, 1.0), ("10", 8, 10.0)],
            "camera": [("0", 10, 0.01), ("2", 3, 0.1)],
            "smoke": [("0", 10, 0.01), ("0.5", 5, 0.01), ("1", 0, 0.01)],
        }.items()
    },
}


def test_the_table_has_a_row_for_every_level():
    rows = stress.table(FOUND)[1:]
    assert [row[:2] for row in rows[:3]] == [["trocar_offset", f"{x} mm"] for x in (0, 5, 10)]
    assert len(rows) == 8 and "(3/10)" in rows[4][2] and rows[2][3:] == ["5.00", "10.00", "10.00"]


def test_lines_of_a_rank_go_around_through_every_disturbance():
    success, error = stress.draw(FOUND).axes
    lines = [np.array(line.get_ydata()) for line in success.lines]
    np.testing.assert_allclose(lines, [[1, 1, 1, 1], [0.9, 0.3, 0.5, 0.9], [0.8, 0.3, 0, 0.8]])
    # From 0.01 mm in the middle to 10 mm at the rim; where levels end, the highest one stands.
    lines = [np.array(line.get_ydata()) for line in error.lines]
    np.testing.assert_allclose(lines, [[0, 0, 0, 0], [2, 1, 0, 2], [3, 1, 0, 3]], atol=1e-6)


def test_the_verdict_names_the_first_level_with_a_loss_beyond_chance():
    text = stress_page.verdict(FOUND, "it succeeds in")
    assert "10 of 10" in text and "camera 2 mm (30%), smoke 0.5 mm (50%)" in text
    assert "smoke 1 mm" not in text and text.endswith("under trocar_offset.")
    alone = {"trocar_offset": FOUND["disturbances"]["trocar_offset"]}
    assert "first levels" not in stress_page.verdict({"disturbances": alone}, "it succeeds in")


def test_cards_are_of_the_lowest_success_and_the_largest_error():
    plain, low, error = stress_page.cards(FOUND)
    assert (plain.value, low.value, error.value) == ("100", "0", "10.00")
    assert low.more.startswith("smoke 1 mm: 0 of 10") and "trocar_offset 10 mm" in error.more


def test_the_page_of_a_stress_stands_alone_and_has_every_level():
    about = {"scene": fakes.SCENE._asdict(), "weights": "0" * 64, "seed": 0, "time_limit_s": 30.0}
    about |= {"command": "starjax stress <mine>", "versions": {"jax": "0"}}
    failed = [["Disturbance", "Level", "Trials", "Command"], ["smoke", "1", "8-0", "starjax view"]]
    made = stress_page.files({**FOUND, **about}, failed)
    text = made["index.html"].decode()
    assert text.count('class="ci ') == 8 + 2
    assert text.count('href="') == 0 and "<script" not in text and "&lt;mine&gt;" in text
    assert "<code>starjax view</code>" in text
    assert set(made) == {"index.html", "stress.md", "stress.png", "stress.pdf"}


def test_a_report_shows_that_of_its_own_weights(tmp_path):
    folder = synthetic.run(tmp_path / "stardiff")
    weights = json.loads((folder / "result.json").read_text())["weights"]
    file = folder / "stress-seed0" / "stress.json"
    file.parent.mkdir()
    for of, shows in (("others", False), (weights, True)):
        file.write_text(json.dumps({**FOUND, "weights": of}))
        run = results.load(folder)
        assert (run.stress != {}) == shows
        text = page.render([run], run, {"stress": (b"light", b"dark")} if shows else {}, None)
        assert ("trocar_offset" in text) == shows
    file.write_text(json.dumps({"weights": weights}))
    with pytest.raises(ValueError, match="disturbances"):
        results.load(folder)
