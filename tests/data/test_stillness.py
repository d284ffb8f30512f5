"""Still commands are counted by thresholds, in stretches, and skipped in training."""

import types

import jax.numpy as jnp
import numpy as np
import pytest

from starjax.core.types import Command, Pose
from starjax.data import stillness

STEPS = 12


def commands(p=0.0, turn=0.0, jaws=0.0):
    """Two arms; the second moves by `p` m, `turn` rad and `jaws` at each of the steps 3 to 6."""
    moved = np.clip(np.arange(STEPS) - 2, 0, 4)[:, None] * np.array([0.0, 1.0])
    c, s = np.cos(turn * moved), np.sin(turn * moved)
    R = np.tile(np.eye(3), (STEPS, 2, 1, 1))
    R[..., 0, 0], R[..., 0, 1], R[..., 1, 0], R[..., 1, 1] = c, -s, s, c
    at = np.stack([p * moved, 0 * moved, 0 * moved], -1)
    return Command(
        Pose(R.astype(np.float32), at.astype(np.float32)), (jaws * moved).astype(np.float32)
    )


@pytest.mark.parametrize(
    ("motion", "still"),
    [
        ({"p": 4e-5, "turn": np.deg2rad(0.04), "jaws": 0.004}, True),
        ({"p": 6e-5}, False),
        ({"turn": np.deg2rad(0.06)}, False),
        ({"jaws": 0.006}, False),
    ],
)
@pytest.mark.parametrize("kind", [np.asarray, jnp.asarray])
def test_a_command_is_still_below_all_thresholds(motion, still, kind):
    command = commands(**motion)
    before, after = (
        Command(Pose(kind(command.pose.R[i]), kind(command.pose.p[i])), kind(command.gripper[i]))
        for i in (3, 4)
    )
    assert bool(stillness.is_still(before, after)) == still


def test_stretches_have_their_lengths_and_a_final_hold_none():
    still = stillness.still_steps(commands(p=1e-3))
    np.testing.assert_array_equal(stillness.stretches(still), [0, 2, 2, 0, 0, 0, 0, *[5] * 5])
    np.testing.assert_array_equal(stillness.before_the_end(still), [0, 2, 2, *[0] * 9])


def test_numbers_without_units_move_by_a_part_of_their_range():
    values = np.concatenate([np.zeros((8, 2)), np.linspace(0.0, 300.0, 20)[:, None] * [1, 0]])
    values[4, 0] += 0.2  # noise
    assert (stillness.of_numbers(values) > 0).sum() == 8
    text = stillness.text([stillness.of_numbers(values)])
    assert text.startswith(f"{8 / 28:.1%} of frames") and "wait" in text


def test_training_skips_frames_in_long_stretches():
    dataset = types.SimpleNamespace(
        command=commands(p=1e-3), start=np.array([0]), length=np.array([STEPS])
    )
    frames = np.arange(0, STEPS, dtype=np.int32)
    np.testing.assert_array_equal(stillness.skipped(dataset, frames, 2), [0, *range(3, STEPS)])
    assert stillness.skipped(dataset, frames, 3) is not None
    np.testing.assert_array_equal(stillness.skipped(dataset, frames, 3), frames)
    np.testing.assert_array_equal(stillness.skipped(dataset, frames, 0), frames)
