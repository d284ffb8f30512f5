"""Real time, by a clock that the test moves."""

from starjax.addons.viewer.page import Clock


class Hands:
    """A clock that only sleeping and `work` move."""

    def __init__(self):
        self.t, self.slept = 100.0, 0.0

    def now(self):
        return self.t

    def sleep(self, seconds):
        self.t += seconds
        self.slept += seconds


def paced(work, speed=1.0):
    hands = Hands()
    clock = Clock(30.0, hands.now, hands.sleep)
    for seconds in work:
        clock.wait(speed)
        hands.t += seconds
    return clock, hands


def test_quick_work_runs_in_real_time():
    clock, hands = paced([0.004] * 31)
    assert clock.missed == 0 and abs(hands.t - 100.0 - 30 / 30 - 0.004) < 1e-9


def test_a_step_that_takes_long_once_is_made_up_for_without_a_miss():
    clock, hands = paced([0.05] + [0.004] * 30)
    assert clock.missed == 0 and abs(hands.t - 101.0 - 0.004) < 1e-9


def test_late_steps_are_counted_and_not_made_up_for():
    clock, hands = paced([0.2] + [0.004] * 30)
    assert clock.missed == 1 and hands.t > 101.1
    clock, _ = paced([0.2] * 10)
    assert (clock.missed, clock.steps) == (9, 10)


def test_speed():
    _, hands = paced([0.001] * 31, speed=2.0)
    assert abs(hands.t - 100.5 - 0.001) < 1e-9
