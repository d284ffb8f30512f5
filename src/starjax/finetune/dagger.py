"""DAgger with takeovers: an expert finishes the episodes that the policy would not.

Ross et al., arXiv:1011.0686, label every state of the policy's. Here, as in HG-DAgger
(arXiv:1810.02890), the expert controls the robot after the takeover and its own commands are the
labels. Signals of the simulator's state decide the takeover.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from starjax import config, errors
from starjax.finetune.rounds import LearnedEpisode, Way
from starjax.rollouts import episodes, progress, takeover
from starjax.rollouts.agent import BatchAgent
from starjax.sim import registries
from starjax.sim.tasks.base import Task

SOURCE = "intervention"
CLOCK_QUANTILE = 0.95  # of the control steps of the policy's successes
LEAST_RESCUE_S = 15.0  # s, the least that the expert has


def limits(steps: np.ndarray, control_hz: float) -> tuple[takeover.TakeoverLimits, int]:
    """Returns the limits of a policy's part, and the control steps of a whole episode.

    Args:
      steps: `[n]` control steps of the policy's successes, at least one.
      control_hz: commands per second.
    """
    clock = math.ceil(np.quantile(steps, CLOCK_QUANTILE))
    stalled = round(progress.STALLED_S * control_hz)
    return takeover.TakeoverLimits(clock, stalled), clock + max(
        clock, round(LEAST_RESCUE_S * control_hz)
    )


def way(
    policy: BatchAgent,
    params: Any,
    task: Task,
    expert: str,
    settings: config.PolicyConfig,
    limits: takeover.TakeoverLimits,
) -> Way:
    """Makes the search for interventions.

    Args:
      policy: agent of the policy.
      params: its parameters.
      task: with an expert that begins in any state.
      expert: key of `Task.experts` that demonstrated.
      settings: of the policy.
      limits: of the policy's part.

    Raises:
      errors.UsageError: no expert of the task begins in any state.
    """
    name = registries.rescuer_name(task, expert)
    if name not in registries.rescuers.names():
        known = ", ".join(registries.rescuers.names())
        raise errors.UsageError("--by dagger", f"a task and expert of {known}", name)
    agent = takeover.from_policy(policy, registries.rescuers.get(name))
    clock, stalled = np.int32(limits.clock), np.int32(limits.stalled)

    def choose(found: Sequence[episodes.Episode]) -> LearnedEpisode | None:
        return chosen(found[0], settings.obs_horizon)

    return Way(
        source=SOURCE,
        agent=agent,
        params=lambda attempt: (params, takeover.TakeoverLimits(clock, stalled)),
        attempts=1,
        record=takeover.RECORDS[settings.observation],
        choose=choose,
        cause=cause,
        modules=(registries.rescuers.path(name),),
    )


def chosen(episode: episodes.Episode, obs_horizon: int) -> LearnedEpisode | None:
    """Returns the expert's part of an episode that it finished, else None.

    Before it are O - 1 frames of the policy, which windows of length O observe.
    """
    numbers = episode.joined(takeover.CAUSE)
    if not episode.outcome["success"] or not numbers.any():
        return None
    step = int(np.argmax(numbers > 0))
    about = {"step": step, "cause": cause([episode])}
    return LearnedEpisode(episode, max(step - (obs_horizon - 1), 0), about)


def cause(found: Sequence[episodes.Episode]) -> str:
    """Returns the cause of the takeover in the only episode of a trial, see `progress.CAUSES`."""
    return progress.CAUSES[int(found[0].joined(takeover.CAUSE).max(initial=0))]
