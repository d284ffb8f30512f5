"""DAgger with takeovers: an expert finishes the episodes that the policy would not.

Ross et al., arXiv:1011.0686, label every state of the policy's. Here, as in HG-DAgger
(arXiv:1810.02890), the expert controls the robot after the takeover and its own commands are the
labels. Signals of the simulator's state decide the takeover. Episodes that the expert then fails,
and those that end before a signal, are played again up to an earlier state.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from starjax.addons.finetune.rounds import LearnedEpisode, Way
from starjax.core import config, errors, sources
from starjax.sim import registries, wrists
from starjax.sim.rollouts import episodes, progress, takeover
from starjax.sim.rollouts.agent import BatchAgent
from starjax.sim.task import Task

NAME = "dagger"
CLOCK_QUANTILE = 0.95  # quantile of the control steps of the policy's successes
LEAST_RESCUE_S = 15.0  # s, the least that the expert has
REWINDS_S = (1.0, 2.0, 4.0)  # s before progress ended, at which the expert takes over instead
ENDS = ("invalid", "collided", "lost")  # causes of an episode that no signal announced


def limits(
    steps: np.ndarray, control_hz: float, stalled_s: float
) -> tuple[takeover.TakeoverLimits, int]:
    """Returns the limits of a policy's part, and the control steps of a whole episode.

    Args:
      steps: `[n]` control steps of the policy's successes, at least one.
      control_hz: commands per second.
      stalled_s: s without progress, see `Task`.
    """
    clock = math.ceil(np.quantile(steps, CLOCK_QUANTILE))
    stalled = round(stalled_s * control_hz)
    return takeover.TakeoverLimits(clock, stalled), clock + max(
        clock, round(LEAST_RESCUE_S * control_hz)
    )


def rescuer(task: Task, expert: str) -> str:
    """Returns the name in `registries.rescuers` of a task's expert.

    Raises:
      errors.UsageError: it begins in no other state than the first.
    """
    name = registries.rescuer_name(task, expert)
    if name not in registries.rescuers.names():
        known = ", ".join(registries.rescuers.names())
        raise errors.UsageError(f"--by {NAME}", f"a task and expert of {known}", name)
    return name


def way(
    policy: BatchAgent,
    params: Any,
    task: Task,
    expert: str,
    settings: config.PolicyConfig,
    limits: takeover.TakeoverLimits,
    control_hz: float,
) -> Way:
    """Makes the search for interventions.

    Args:
      policy: agent of the policy.
      params: its parameters.
      task: with an expert that begins in any state.
      expert: key of `Task.experts` that demonstrated.
      settings: of the policy.
      limits: of the policy's part.
      control_hz: commands per second.

    Raises:
      errors.UsageError: the expert begins in no other state than the first.
    """
    name = rescuer(task, expert)
    agent = takeover.from_policy(policy, wrists.rescuer(task, name))
    stalled = np.int32(limits.stalled)

    def choose(found: Sequence[episodes.Episode]) -> LearnedEpisode | None:
        return chosen(found, settings.obs_horizon)

    return Way(
        source=takeover.INTERVENTION,
        agent=agent,
        params=lambda clocks: (params, takeover.TakeoverLimits(clocks, stalled)),
        runs=(limits.clock,),
        record=takeover.RECORDS[settings.observation],
        choose=choose,
        cause=lambda found: cause(found[0]),
        parts=(sources.identity(registries.rescuers, name),),
        again=lambda found: earlier(found[0], control_hz),
    )


def earlier(episode: episodes.Episode, control_hz: float) -> list[int]:
    """Returns the steps of earlier takeovers of a failed episode, the latest first.

    A trial is a function of its key: played again, it reaches the same states, which need not be
    stored. At the signal the error is already made.
    """
    if episode.outcome["success"]:
        return []
    progressed = int(episode.joined(takeover.PROGRESSED)[_taken_over(episode)])
    steps = (max(progressed - round(back * control_hz), 0) for back in REWINDS_S)
    return list(dict.fromkeys(steps))


def chosen(found: Sequence[episodes.Episode], obs_horizon: int) -> LearnedEpisode | None:
    """Returns the expert's part of the latest takeover that succeeded, else None.

    Before it are O - 1 frames of the policy, which windows of length O observe.

    Args:
      found: episodes of a trial, the one with the latest takeover first.
      obs_horizon: O.
    """
    for run, episode in enumerate(found):
        if episode.outcome["success"]:
            if not episode.joined(takeover.CAUSE).any():
                return None  # the policy's own
            step = _taken_over(episode)
            about = {"step": step, "cause": cause(found[0]), "rewound": run}
            return LearnedEpisode(episode, max(step - (obs_horizon - 1), 0), run, about)
    return None


def cause(episode: episodes.Episode) -> str:
    """Returns the cause of the takeover, or the flag of a policy's episode that ended without.

    See `progress.CAUSES` and `ENDS`.
    """
    number = int(episode.joined(takeover.CAUSE).max(initial=0))
    ends = (name for name in ENDS if not number and episode.outcome[name])
    return next(ends, progress.CAUSES[number])


def _taken_over(episode: episodes.Episode) -> int:
    """Returns the step of the takeover, the last one without."""
    numbers = episode.joined(takeover.CAUSE) > 0
    return int(np.argmax(numbers)) if numbers.any() else len(numbers) - 1
