"""Rounds of a policy gradient: episodes with noise and steps by turns, then the round's policy."""

import functools
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from starjax import errors
from starjax.commands import finetune_stages, messages, stage_times
from starjax.commands.finetune_work import Work
from starjax.finetune import dagger, explore, mixing, policy_gradient
from starjax.policies import features, generator, policy_file
from starjax.policies.in_env import PolicyInEnv
from starjax.rcm.trocar import Trocar
from starjax.rollouts import trocars as configurations
from starjax.runtime import files

STREAM = 0x726C  # of its starts, folded into the seed's key, then the number of the round
ALONE = 1  # first iterations of a round, in which the critic learns alone
AGAIN = 0.5  # share of an iteration's episodes whose starts failed in the one before


class PolicyGradient:
    """The programs of all rounds, and the demonstrations that hold the policy."""

    def __init__(self, work: Work, steps: np.ndarray):
        """Builds them; `steps` `[n]` are the control steps of the policy's successes."""
        if not len(steps):
            raise errors.UsageError("RUN", "a policy with some success", "none in validation")
        self._work, config, env = work, work.config, work.base.env
        policy = finetune_stages.one_step_policy(work, config.policy)
        limits, _ = dagger.limits(steps, env.control_hz)
        commands = config.policy.execute
        static = explore.ExploreSettings(
            config.policy.obs_horizon,
            commands,
            math.ceil(2 * limits.clock / commands),
            work.settings.noise,
        )
        see = _make_see(config.policy) if config.policy.observation == "image" else None
        self._play = explore.make(env, policy, see, env.names.cameras, static)
        self._adam = policy_gradient.optimizer(work.settings.gradient_rate)
        self._learn = policy_gradient.make(policy, self._adam, static, config.policy.horizon)
        self._demonstrations = policy_gradient.demonstrated(
            finetune_stages.Lessons(work).demonstrations(), config.train.holdout_demos
        )
        self._trocars = configurations.listed(work.seen, len(env.p_world_ref))

    def round(self, number: int, who: PolicyInEnv, before: Path) -> finetune_stages.Round:
        """Runs the iterations of a round from the weights of a file, unless they are done."""
        folder = self._work.folder(number)
        file, told = folder / "policy.safetensors", folder / "iterations.json"
        if file.exists() and told.exists():
            return file, files.read_json(told)
        print(f"\n[round {number}] policy gradient: into {folder}", flush=True)
        with stage_times.timed(self._work.out, f"round {number} policy gradient"):
            old = policy_file.load(before)
            params, rows = self._iterate(number, old)
        counts = {"episodes": self._work.settings.episodes, "iterations": rows}
        folder.mkdir(parents=True, exist_ok=True)
        files.write_json(told, counts)
        policy_file.save(file, old._replace(params=params, monitor=None))
        return file, counts

    def _iterate(self, number: int, old: policy_file.Trained) -> tuple[Any, list[dict[str, Any]]]:
        """Returns the parameters after the last iteration, and the figures of all."""
        settings = self._work.settings
        stats = mixing.with_reach(old.normalizer)
        vision = old.params.get("vision")
        params = {name: part for name, part in old.params.items() if name != "vision"}
        root = jax.random.fold_in(jax.random.fold_in(jax.random.key(settings.seed), STREAM), number)
        key_reset, key_play, key_learn = jax.random.split(root, 3)
        draws = np.random.default_rng([settings.seed, STREAM, number])
        learning, rows = None, []
        failed = np.zeros((0, 2), np.int32)
        for i in range(settings.iterations):
            starts = self._starts(i, failed, draws)
            again = (starts.trial < i * settings.episodes).astype(bool)
            here = functools.partial(jax.random.fold_in, data=i)
            now = params if learning is None else learning.params
            played = self._play(now, vision, stats, starts, key_reset, here(key_play))
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
            rows.append(row)
            messages.indented(
                f"iteration {i + 1}: {row['success']:.1%} succeed, {row['steps']:.0f} steps, "
                f"KL {row['kl']:.2g}, largest commanded RCM error {row['rcm_commanded_mm']:.2g} mm"
            )
        assert learning is not None
        trained = jax.device_get(learning.params)
        return trained if vision is None else {**trained, "vision": vision}, rows

    def _starts(self, iteration: int, failed: np.ndarray, draws: np.random.Generator) -> Any:
        """Returns new starts, and some of those `[M, 2]` that failed before."""
        count = self._work.settings.episodes
        index = np.arange(count, dtype=np.int32) % len(self._trocars.radius)
        trial = iteration * count + np.arange(count, dtype=np.int32)
        if len(failed):
            old = np.arange(int(AGAIN * count))
            index[old], trial[old] = failed[draws.integers(len(failed), size=len(old))].T
        fields = Trocar(*(np.asarray(field)[index] for field in self._trocars))
        return explore.Starts(fields, index, trial)


def _make_see(policy_config: Any) -> explore.See:
    """Returns the encoder on centre crops, as inference sees them."""
    vision = generator.vision_encoder(policy_config)

    def see(params: Any, images: jax.Array) -> jax.Array:
        return jnp.asarray(vision.apply(params, features.centre_crop(policy_config, images)))

    return see
