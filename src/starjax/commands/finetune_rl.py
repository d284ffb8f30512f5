"""Rounds of a policy gradient: episodes with noise and steps by turns, then the round's policy."""

import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from starjax.commands import finetune_stages, messages, stage_times
from starjax.commands.finetune_play import NoisyEpisodes
from starjax.commands.finetune_work import Work
from starjax.finetune import mixing, policy_gradient
from starjax.policies import policy_file
from starjax.policies.in_env import PolicyInEnv
from starjax.runtime import files

STREAM = 0x726C  # of its starts, folded into the seed's key, then the number of the round
ALONE = 1  # first iterations of a round, in which the critic learns alone


class PolicyGradient:
    """The programs of all rounds, and the demonstrations that hold the policy."""

    def __init__(self, work: Work, steps: np.ndarray):
        """Builds them; `steps` as for the `NoisyEpisodes`."""
        self._work, config = work, work.config
        policy = finetune_stages.one_step_policy(work, config.policy)
        self._episodes = NoisyEpisodes(work, policy, steps)
        self._adam = policy_gradient.optimizer(work.settings.gradient_rate)
        self._learn = policy_gradient.make(
            policy, self._adam, self._episodes.settings, config.policy.horizon
        )
        self._demonstrations = policy_gradient.demonstrated(
            finetune_stages.Lessons(work).demonstrations(), config.train.holdout_demos
        )

    def round(self, number: int, who: PolicyInEnv, before: Path) -> finetune_stages.Round:
        """Runs the iterations of a round from the weights of a file, unless they are done."""
        folder = self._work.folder(number)
        file, told = folder / "policy.safetensors", folder / "iterations.json"
        if file.exists() and told.exists():
            return file, files.read_json(told)
        print(f"\n[round {number}] policy gradient: into {folder}", flush=True)
        folder.mkdir(parents=True, exist_ok=True)
        counts: dict[str, Any] = {"episodes": self._work.settings.episodes, "iterations": []}
        with stage_times.timed(self._work.out, f"round {number} policy gradient"):
            old = policy_file.load(before)
            params = old.params
            for trained, row in self._iterate(number, old):
                params = {**old.params, **trained}
                counts["iterations"].append(row)
                files.write_json(told, counts)  # those of a stopped round, too
        policy_file.save(file, old._replace(params=jax.device_get(params), monitor=None))
        return file, counts

    def _iterate(
        self, number: int, old: policy_file.Trained
    ) -> Iterator[tuple[Any, dict[str, Any]]]:
        """Yields the parameters after each iteration, and its figures."""
        settings = self._work.settings
        stats = mixing.with_reach(old.normalizer)
        vision = old.params.get("vision")
        params = {name: part for name, part in old.params.items() if name != "vision"}
        root = jax.random.fold_in(jax.random.fold_in(jax.random.key(settings.seed), STREAM), number)
        key_reset, key_play, key_learn = jax.random.split(root, 3)
        draws = np.random.default_rng([settings.seed, STREAM, number])
        learning = None
        failed = np.zeros((0, 2), np.int32)
        for i in range(settings.iterations):
            starts = self._episodes.starts(i, failed, draws)
            again = (starts.trial < i * settings.episodes).astype(bool)
            here = functools.partial(jax.random.fold_in, data=i)
            now = params if learning is None else learning.params
            played = self._episodes.play(now, vision, stats, starts, key_reset, here(key_play))
            if learning is None:
                learning = policy_gradient.begin(self._adam, params, key_learn, played)
            learning, metrics = self._learn(
                learning, stats, played, self._demonstrations, here(key_learn), i >= ALONE
            )
            success = np.asarray(played.success)
            lost = np.stack([starts.index, starts.trial], -1)[~success]
            failed = np.unique(lost, axis=0)
            row = {
                "success": float(success[~again].mean()),
                **({"success_again": float(success[again].mean())} if again.any() else {}),
                **{name: float(value) for name, value in metrics.items()},
                "rcm_commanded_mm": 1e3 * float(played.rcm_commanded),
                "rcm_executed_mm": 1e3 * float(played.rcm_executed),
            }
            messages.indented(
                f"iteration {i + 1}: {row['success']:.1%} succeed, {row['steps']:.0f} steps, "
                f"KL {row['kl']:.2g}, largest commanded RCM error {row['rcm_commanded_mm']:.2g} mm"
            )
            yield learning.params, row
