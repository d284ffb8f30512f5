"""Rounds of a distillation: the policy of the round before teaches its own one step.

A round begins with episodes of that policy, at whose states it teaches too.
"""

from pathlib import Path
from typing import Any

import jax
import numpy as np

from starjax.addons.finetune import distill, mixing, policy_gradient
from starjax.addons.finetune.commands import finetune_stages
from starjax.addons.finetune.commands.finetune_play import NoisyEpisodes, PolicyParams
from starjax.addons.finetune.commands.finetune_work import Work
from starjax.cli import messages, stage_times
from starjax.core.types import ArrayTree
from starjax.data import normalizer
from starjax.policies import policy_file
from starjax.policies.in_env import PolicyInEnv

STREAM = 0x6469  # stream of its draws, folded into the seed's key, then the number of the round
CALL = 500  # steps between two lines


class Distillation:
    """The program of all rounds, and the demonstrations whose windows are learned."""

    def __init__(self, work: Work, steps: np.ndarray):
        """Builds them; `steps` as for the `NoisyEpisodes`."""
        self._work, config = work, work.config
        policy, flow = (
            finetune_stages.one_step_policy(work, settings)
            for settings in (config.policy, distill.flow_settings(config.policy))
        )
        self._episodes = NoisyEpisodes(work, policy, steps)
        self._learn = distill.make(policy, flow, config.policy, config.train)
        self._demonstrations = policy_gradient.demonstrated(
            finetune_stages.Lessons(work).demonstrations(), config.train.holdout_demos
        )

    def round(self, number: int, who: PolicyInEnv, before: Path) -> finetune_stages.Round:
        """Trains a round from the weights of a file, unless it is done."""
        work, folder = self._work, self._work.folder(number)
        file = folder / "policy.safetensors"
        if file.exists():
            return file, {}
        print(f"\n[round {number}] distillation: into {folder}", flush=True)
        old, total = policy_file.load(before), work.config.train.steps
        frozen = {name: part for name, part in old.params.items() if name != "vision"}
        stats = mixing.with_reach(old.normalizer)
        key = jax.random.fold_in(jax.random.key(work.settings.seed), STREAM)
        key, student = jax.random.fold_in(key, number), distill.begin(work.config.train, frozen)
        with stage_times.timed(work.out, f"round {number} rollouts"):
            played = self._play(number, frozen, old.params.get("vision"), stats, key)
        success = float(played.success.mean())
        messages.indented(f"{success:.1%} of {len(played.success)} noisy episodes succeed")
        visited = distill.visited(played, np.random.default_rng([work.settings.seed, STREAM]))
        error = np.nan
        with stage_times.timed(work.out, f"round {number} training"):
            for first in range(0, total, CALL):
                count = min(CALL, total - first)
                student, error = self._learn(
                    student, frozen, stats, self._demonstrations, visited, key, first, count
                )
                messages.indented(f"step {first + count} of {total}: error {float(error):.2g}")
        folder.mkdir(parents=True, exist_ok=True)
        params = {**old.params, **jax.device_get(student.average)}
        # With the reach of the rounds the validation's program is that of the policy itself.
        policy_file.save(file, old._replace(params=params, normalizer=stats, monitor=None))
        return file, {"error": float(error), "success": success}

    def _play(
        self,
        number: int,
        params: ArrayTree,
        vision: Any,
        stats: normalizer.Normalizer,
        key: jax.Array,
    ) -> Any:
        """Returns the experience of a policy in a round."""
        key_reset, key_play = jax.random.split(jax.random.fold_in(key, 0))
        draws = np.random.default_rng(number)
        starts = self._episodes.starts(number, np.zeros((0, 2), np.int32), draws)
        keys, noise = (key_reset, key_play), self._work.settings.noise
        return self._episodes.play(PolicyParams(params, vision, stats), starts, keys, noise)
