"""Alarms of a runtime monitor in an evaluation: scores of the trials, and the figures of a result.

alpha, count          of the calibration
clock_s               s, alarm of a monitor that only has a clock, at the same alpha
announced             failures with an alarm; {successes, trials, rate, ci95}, as all rates
before_clock          failures with an alarm before `clock_s`
false_alarms          successes with an alarm
silent                successes among the trials without an alarm
median_s              s, median time of the alarms on failures, null without one
by_score              number of alarms on failures by the score that raised them
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from starjax.evaluation import statistics
from starjax.evaluation import trials as tables
from starjax.policies.monitor import record, scores
from starjax.sim.rollouts import plans
from starjax.sim.rollouts.episodes import Episode


def of_episodes(
    episodes: Sequence[Episode], settings: scores.ScoreSettings, max_steps: int
) -> np.ndarray:
    """Returns the scores `[M, D, S]` of episodes with the fields of `plans.record`.

    D is the number of decisions of a trial of `max_steps` control steps; NaN after a trial's end.
    """
    decisions = math.ceil(max_steps / settings.execute)
    found = np.full((len(episodes), decisions, len(scores.NAMES)), np.nan, np.float32)
    for row, episode in zip(found, episodes, strict=True):
        names = (plans.PLANNED, plans.AHEAD, plans.MEASURED, plans.OPENING)
        planned, ahead, measured, opening = map(episode.joined, names)
        values = scores.of_trial(planned, ahead, measured, opening, settings)
        row[: len(values)] = values
    return found


def compose(table: tables.Table, monitor: record.Monitor) -> dict[str, Any]:
    """Returns the figures documented at the top of this file, from a table with scores."""
    assert table.scores is not None
    times, score = record.first_alarms(monitor, table.scores)
    is_raised, is_failure = np.isfinite(times), ~table.success
    raised = is_raised & is_failure
    return {
        "alpha": monitor.alpha,
        "count": monitor.count,
        "clock_s": monitor.clock_s,
        "announced": statistics.rate(is_raised[is_failure]),
        "before_clock": statistics.rate((times < monitor.clock_s)[is_failure]),
        "false_alarms": statistics.rate(is_raised[table.success]),
        "silent": statistics.rate(table.success[~is_raised]),
        "median_s": float(np.median(times[raised])) if raised.any() else None,
        "by_score": {name: int(np.sum(score[raised] == i)) for i, name in enumerate(scores.NAMES)},
    }
