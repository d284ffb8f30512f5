"""Rounds of a distillation: the policy of the round before teaches its own one step."""

from pathlib import Path

import jax
import numpy as np

from starjax.commands import finetune_stages, messages, stage_times
from starjax.commands.finetune_work import Work
from starjax.finetune import distill, mixing, policy_gradient
from starjax.policies import policy_file
from starjax.policies.in_env import PolicyInEnv

STREAM = 0x6469  # of its draws, folded into the seed's key, then the number of the round
CALL = 500  # steps between two lines


class Distillation:
    """The program of all rounds, and the demonstrations whose windows are learned."""

    def __init__(self, work: Work, steps: np.ndarray):
        """Builds them; `steps` are not used."""
        self._work, config = work, work.config
        policy, flow = (
            finetune_stages.one_step_policy(work, settings)
            for settings in (config.policy, distill.flow_settings(config.policy))
        )
        self._learn = distill.make(policy, flow, config.policy, config.train)
        self._demonstrations = policy_gradient.demonstrated(
            finetune_stages.Lessons(work).demonstrations(), config.train.holdout_demos
        )

    def round(self, number: int, who: PolicyInEnv, before: Path) -> finetune_stages.Round:
        """Trains a round from the weights of a file, unless it is done; returns its last error."""
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
        error = np.nan
        with stage_times.timed(work.out, f"round {number} training"):
            for first in range(0, total, CALL):
                count = min(CALL, total - first)
                student, error = self._learn(
                    student, frozen, stats, self._demonstrations, key, first, count
                )
                messages.indented(f"step {first + count} of {total}: error {float(error):.2g}")
        folder.mkdir(parents=True, exist_ok=True)
        params = {**old.params, **jax.device_get(student.average)}
        policy_file.save(file, old._replace(params=params, monitor=None))
        return file, {"error": float(error)}
