"""The report of a fine-tuning: rounds, and the policy before and after."""

import shutil

import pytest
import synthetic

from starjax.addons.finetune.commands import finetune_page
from starjax.report import build


def rate(successes):
    return {"successes": successes, "trials": 48}


CONTENT = {
    "by": "dagger",
    "rounds": [
        {"round": 0, "validation": rate(30)},
        {
            "round": 1,
            "validation": rate(44),
            "learned": 17,
            "takeovers": {"lost": {"successes": 0, "trials": 3}, "stalled": rate(18)},
        },
        {"round": 2, "validation": rate(40), "iterations": [{}, {}], "episodes": 64},
    ],
}


@pytest.fixture
def out(tmp_path, monkeypatch):
    """Results before and after; the figures and the film have tests of their own."""
    monkeypatch.setattr(build, "_figures", lambda runs, focus: ({}, {}))
    for name in ("_film", "_playback"):
        monkeypatch.setattr(build, name, lambda *_: None)
    synthetic.run(tmp_path / "before", skill=(0.6, 0.3))
    shutil.copytree(tmp_path / "before", tmp_path / "after")
    return tmp_path


def test_the_page_compares_the_best_round_with_the_policy_itself(out):
    shutil.rmtree(out / "after")
    synthetic.run(out / "after", skill=(0.95, 0.9))
    text = finetune_page.write(out, {**CONTENT, "best": 1}).read_text()
    assert "is significant" in text and "Peg transfer, fine-tuned by dagger" in text
    for shown in ("1, kept", "17 episodes; the expert finished 18 of 51 takeovers"):
        assert shown in text
    assert "2 iterations of 64 episodes" in text and "30/48" in text and "44/48" in text
    assert text.count("Before") > 3 and text.count("After round 1") > 3
    assert "Only Before" in text  # the paired test


def test_a_difference_within_chance_is_no_gain(out):
    assert "may be chance" in finetune_page.write(out, {**CONTENT, "best": 1}).read_text()


def test_without_a_better_round_the_page_is_of_the_policy_itself(out):
    text = finetune_page.write(out, {**CONTENT, "best": 0}).read_text()
    assert "so the policy is unchanged" in text and "0, the policy itself, kept" in text
    assert "After round" not in text and "Trocar by trocar" in text
