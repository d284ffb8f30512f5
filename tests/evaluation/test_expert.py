"""Rests of experts count before the last settle of the judge, in successes alone."""

import types

import numpy as np
import pytest

from starjax.evaluation import expert


@pytest.mark.parametrize(
    ("settle", "rests"),
    [
        (3, [4]),  # the first episode rests 4 steps on its way, and in the last 3
        (5, [4]),
        (7, [2]),  # a part of the way is judged
        (1, [0]),  # the whole episode is
    ],
)
def test_rests_end_with_the_last_settle(settle, rests):
    still = np.zeros((2, 12), bool)
    still[0, 1:5] = still[0, 7:10] = still[1] = True
    last = types.SimpleNamespace(step=np.array([10, 12]), success=np.array([True, False]))
    episodes = types.SimpleNamespace(last=last, still=still)
    np.testing.assert_array_equal(expert.longest_rests(episodes, settle), rests)
