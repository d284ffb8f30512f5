"""Parts of a mistake: the argument, the expected and the actual value, a hint."""

import pickle

import mistakes
import numpy as np
import pytest

from starjax.cli import options
from starjax.core import errors
from starjax.policies import packaged


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (errors.UsageError("seed", "0 or more", -1), "--seed: expected 0 or more, got -1"),
        (
            errors.UsageError("policy.roll_width", "1 to 9", 10, "lower train.batch_size"),
            "--policy.roll-width: expected 1 to 9, got 10; lower --train.batch-size",
        ),
        (errors.UsageError("RUN", "a folder", "none"), "RUN: expected a folder, got none"),
        (errors.UsageError("--out", "a folder", "x"), "--out: expected a folder, got x"),
        (
            errors.UsageError("runs/train.steps", "settings", "a/policy.dtype.json"),
            "runs/train.steps: expected settings, got a/policy.dtype.json",
        ),
        (errors.UsageError("JAX_PLATFORMS", "x", "y"), "JAX_PLATFORMS: expected x, got y"),
    ],
)
def test_the_commands_spell_fields_as_flags(error, line):
    assert options.spelled(error) == line


def test_a_choice_suggests_the_nearest_name():
    errors.choice("method", "stardiff", ["dp_ee", "stardiff"])
    with mistakes.of("method", "stardif") as caught:
        errors.choice("method", "stardif", ["dp_ee", "stardiff"])
    assert caught.value.expected == "one of dp_ee, stardiff"
    assert caught.value.hint == "did you mean stardiff?"
    with mistakes.of("method", "x") as caught:
        errors.choice("method", "x", ["dp_ee"])
    assert caught.value.hint == ""


@pytest.mark.parametrize(
    ("word", "hint"),
    [
        ("peg", "did you mean peg_transfer or peg_transfer_bimanual?"),
        ("needle_pik", "did you mean needle_pick?"),
        ("Reach", "did you mean reach?"),
        ("handover", "did you mean needle_handover?"),
        ("bimanual", "did you mean peg_transfer_bimanual?"),
        ("x", ""),
    ],
)
def test_a_part_of_a_name_is_near_to_it(word, hint):
    known = ["peg_transfer", "peg_transfer_bimanual", "needle_pick", "needle_handover", "reach"]
    assert errors.nearest(word, known) == hint


def test_a_packaged_policy_is_suggested():
    with mistakes.of("--policy", "compactt") as caught:
        packaged.find("--policy", "compactt")
    assert caught.value.hint == "did you mean compact?"


def test_a_mistake_within_a_mistake_is_one():
    inner = errors.UsageError("root", "a folder", "x/dataset.json: No such file")
    assert str(errors.UsageError("DATASET", "demonstrations", inner)) == (
        "DATASET: expected demonstrations, got x/dataset.json: No such file"
    )


def test_texts_of_others_cannot_steer_the_terminal():
    text = "a\x1b]52;c;eHg=\x07b\u202ec\nä"
    assert errors.printable(text) == "a\\x1b]52;c;eHg=\\x07b\\u202ec\nä"


def test_an_error_of_another_process_keeps_its_fields():
    error = pickle.loads(pickle.dumps(errors.UsageError("image", "uint8", np.float32, "cast it")))
    assert (error.argument, error.hint) == ("image", "cast it") and "float32" in str(error)
