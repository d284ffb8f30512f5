"""Self-imitation: a policy learns its own successes where it also fails.

Every start is tried several times with more noise than in use; where some attempts succeed and some
fail, a success is learned. It is the control of the other ways: policies mostly repeat
themselves (SIME, arXiv:2505.01396).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from starjax.addons.finetune import attempts
from starjax.addons.finetune.rounds import LearnedEpisode, Way
from starjax.core import config, errors
from starjax.rollouts import episodes, progress, takeover
from starjax.rollouts.agent import BatchAgent

NAME, SOURCE = "self", "success"
ATTEMPTS = 3  # attempts of each start
TEMPERATURE = 1.0  # scale of the noise that a sample begins with, that of training


def noisy(policy: config.PolicyConfig) -> config.PolicyConfig:
    """Returns a policy's settings with the noise of training.

    Raises:
      errors.UsageError: its learner has no such setting.
    """
    if not hasattr(policy.options, "temperature"):
        expected = "a learner with a temperature (diffusion, flow, onestep)"
        raise errors.UsageError(f"--by {NAME}", expected, policy.learner)
    return config.with_options(policy, temperature=TEMPERATURE)


def way(policy: BatchAgent, params: Any, observation: str) -> Way:
    """Makes the search for successes; the policy is one with `noisy` settings."""
    return Way(
        source=SOURCE,
        agent=attempts.repeated(policy),
        params=lambda numbers: (params, numbers),
        runs=tuple(range(ATTEMPTS)),
        record=attempts.RECORDS[observation],
        choose=chosen,
        cause=lambda found: progress.CAUSES[0],
    )


def chosen(found: Sequence[episodes.Episode]) -> LearnedEpisode | None:
    """Returns the first success of a start that was also failed, else None."""
    won = [run for run, episode in enumerate(found) if episode.outcome["success"]]
    if len(won) in (0, len(found)):
        return None
    episode = found[won[0]]
    actor = {takeover.ACTOR: [np.full(episode.outcome["length"], takeover.POLICY, np.uint8)]}
    kept = episode._replace(arrays={**episode.arrays, **actor})
    return LearnedEpisode(kept, 0, won[0], {})
