"""The signals of a takeover, and the expert that begins at the state of the signal."""

import types

import jax.numpy as jnp
import numpy as np
import pytest

from starjax.rollouts import progress


def stalls(rewards, steps=4):
    memory, found = progress.begin(), []
    for step, reward in enumerate(rewards):
        state = types.SimpleNamespace(reward=jnp.float32(reward), step=jnp.int32(step))
        memory, stalled = progress.update(memory, state, steps)
        found.append(bool(stalled))
    return found


def test_an_episode_stalls_once_its_best_reward_is_old():
    assert stalls([0.1, 0.2, 0.2, 0.2, 0.2]) == [False] * 5
    assert stalls([0.1, 0.2, 0.2, 0.2, 0.2, 0.2]) == [False] * 5 + [True]
    # Less than the gain, and a reward that comes back to its best, count for nothing.
    assert stalls([0.5, 0.51, 0.515, 0.519, 0.519])[-1]
    assert stalls([0.5, 0.3, 0.4, 0.5, 0.5])[-1]
    assert not stalls([0.5, 0.3, 0.4, 0.53, 0.5])[-1]


@pytest.mark.parametrize(
    ("signals", "cause"),
    [
        ((0, 0, 0), "none"),
        ((1, 0, 0), "stalled"),
        ((1, 1, 0), "clock"),
        ((0, 1, 1), "nearly lost"),
    ],
)
def test_the_most_urgent_cause_counts(signals, cause):
    number = progress.cause(*map(jnp.bool_, signals))
    assert progress.CAUSES[int(number)] == cause and number.dtype == np.int32
