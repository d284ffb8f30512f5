"""Rounds of a policy gradient: episodes with noise and steps by turns, then the round's policy."""

import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from starjax.addons.finetune import explore, mixing, noise_level, policy_gradient
from starjax.addons.finetune.commands import finetune_stages
from starjax.addons.finetune.commands.finetune_play import NoisyEpisodes, PolicyParams
from starjax.addons.finetune.commands.finetune_work import Work
from starjax.cli import messages, stage_times
from starjax.policies import policy_file
from starjax.policies.in_env import PolicyInEnv
from starjax.runtime import files, precompile

STREAM = 0x726C  # stream of its starts, folded into the seed's key, then the number of the round
ALONE = 1  # first iterations, in which the critic learns alone


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
        player = _player(work.stored)
        shapes: list[Any] = []  # jobs are traced in their order
        precompile.start(lambda: shapes.append(self._episodes.prepare(player)))
        self._demonstrations = policy_gradient.demonstrated(
            finetune_stages.Lessons(work).demonstrations(), config.train.holdout_demos
        )
        self._prepared = precompile.start(lambda: self._prepare(player, *shapes))
        # The policy file of the last round -> parameters, optimiser and critic, which are None
        # before the first iteration, and the deviation of the plans' displacements.
        self._progress: dict[Path, tuple[policy_gradient.Learning | None, float]] = {}

    def round(self, number: int, who: PolicyInEnv, before: Path) -> finetune_stages.Round:
        """Runs the iterations of a round from the weights of a file, unless they are done."""
        folder = self._work.folder(number)
        file, told = folder / "policy.safetensors", folder / "iterations.json"
        if file.exists() and told.exists():
            return file, files.read_json(told)
        print(f"\n[round {number}] policy gradient: into {folder}", flush=True)
        folder.mkdir(parents=True, exist_ok=True)
        self._prepared()  # a program called before it is traced would be compiled twice
        counts: dict[str, Any] = {"episodes": self._work.settings.episodes, "iterations": []}
        with stage_times.timed(self._work.out, f"round {number} policy gradient"):
            old = policy_file.load(before)
            player = _player(old)
            learning, noise = self._progress.get(before, (None, None))
            if noise is None:
                counts["noise_levels"] = self._tried(number, player)
                noise = noise_level.chosen(counts["noise_levels"])
            counts["noise"] = noise
            for after, row in self._iterate(number, player, learning, noise):
                learning = after
                counts["iterations"].append(row)
                files.write_json(told, counts)  # those of a stopped round, too
        learned = learning.params if learning else {}
        params = {**old.params, **jax.device_get(learned)}
        # With the reach of the rounds the validation's program is that of the policy itself.
        policy_file.save(file, old._replace(params=params, normalizer=player.stats, monitor=None))
        self._progress = {file: (learning, noise)}
        return file, counts

    def _prepare(self, who: PolicyParams, played: explore.Experience) -> None:
        """Begins to compile the program of the steps, for experience of these shapes."""
        begin = functools.partial(policy_gradient.begin, self._adam)
        key = jax.random.key(0)
        learning = jax.eval_shape(begin, who.params, key, played)
        self._learn.prepare(learning, who.stats, played, 0.0, self._demonstrations, key, True)

    def _keys(self, number: int) -> tuple[Any, Any, Any]:
        """Returns the keys of a round: of starts, of episodes' noise, of learning."""
        root = jax.random.key(self._work.settings.seed)
        for part in (STREAM, number):
            root = jax.random.fold_in(root, part)
        return tuple(jax.random.split(root, 3))

    def _tried(self, number: int, who: PolicyParams) -> list[dict[str, Any]]:
        """Returns the success at several levels of noise, from starts that no iteration has."""
        settings = self._work.settings
        key_reset, key_play, _ = self._keys(number)
        tried = self._episodes.probe(who, settings.iterations, (key_reset, key_play))
        for row in tried:
            messages.indented(f"noise {row['noise']:.2g}: {messages.rate(row)}")
        messages.indented(f"noise {noise_level.chosen(tried):.2g} is used")
        return tried

    def _iterate(
        self,
        number: int,
        who: PolicyParams,
        learning: policy_gradient.Learning | None,
        noise: float,
    ) -> Iterator[tuple[policy_gradient.Learning | None, dict[str, Any]]]:
        """Yields the state of the learning after each iteration, and its figures."""
        settings = self._work.settings
        key_reset, key_play, key_learn = self._keys(number)
        draws = np.random.default_rng([settings.seed, STREAM, number])
        failed = np.zeros((0, 2), np.int32)
        alone = ALONE if learning is None else 0
        for i in range(settings.iterations):
            if self._work.is_late():
                messages.indented("time is up: the round ends")
                return
            starts = self._episodes.starts(i, failed, draws)
            again = (starts.trial < i * settings.episodes).astype(bool)
            here = functools.partial(jax.random.fold_in, data=i)
            now = who.params if learning is None else learning.params
            played = self._episodes.play(
                who._replace(params=now), starts, (key_reset, here(key_play)), noise
            )
            if learning is None:
                learning = policy_gradient.begin(self._adam, who.params, key_learn, played)
            learning, metrics = self._learn(
                learning,
                who.stats,
                played,
                noise,
                self._demonstrations,
                here(key_learn),
                i >= alone,
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
            yield learning, row


def _player(trained: policy_file.Trained) -> PolicyParams:
    """Returns the parameters that play."""
    params = {name: part for name, part in trained.params.items() if name != "vision"}
    return PolicyParams(params, trained.params.get("vision"), mixing.with_reach(trained.normalizer))
