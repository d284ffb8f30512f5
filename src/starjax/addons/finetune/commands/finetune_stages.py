"""Stages of a round of fine-tuning: rollouts, their lessons, training.

Complete ones are skipped.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from starjax.addons.finetune import dagger, mixing, rounds
from starjax.addons.finetune.commands import finetune_checks, finetune_counts, interventions
from starjax.addons.finetune.commands.finetune_work import Work
from starjax.cli import demonstrations, messages, pipeline, policy_evaluation, stage_times
from starjax.core import config as config_lib
from starjax.core import errors, methods
from starjax.data import load, normalizer, store, windows
from starjax.evaluation import statistics, trials
from starjax.policies import policy as policies
from starjax.policies import policy_file
from starjax.policies.in_env import PolicyInEnv
from starjax.runtime import processes
from starjax.runtime.signals import stop_signals
from starjax.sim.rollouts import placement
from starjax.training import loop, randomise
from starjax.training.encoder import Encoder

Round = tuple[Path, dict[str, Any]]  # its policy's file and its counts

_VALIDATION = 0x76616C69  # added to the seed: its trials are not those of the report


def validate(work: Work, number: int, who: PolicyInEnv) -> trials.Table:
    """Returns the trials that choose a round: at the seen trocars, from starts of their own."""
    settings = dataclasses.replace(work.settings.eval, trials=work.settings.validation)
    seed = (work.settings.seed + _VALIDATION) % 2**32
    with stage_times.timed(work.out, f"round {number} validation"):
        folder = work.folder(number) / "validation"
        return policy_evaluation.rollouts(folder, who, work.seen, settings, seed)


class Imitation:
    """Rounds that learn from rollouts, with limits that the policy sets, like demonstrations."""

    def __init__(self, work: Work, steps: np.ndarray):
        """Decides the limits from the control steps `[n]` of the policy's successes."""
        if not len(steps):
            raise errors.UsageError("RUN", "a policy with some success", "none in validation")
        self._work, env = work, work.base.env
        self._limits, self._max_steps = dagger.limits(steps, env.control_hz, env.task.stalled_s)
        self._lessons = Lessons(work)

    def round(self, number: int, who: PolicyInEnv, before: Path) -> Round | None:
        """Runs and learns a round, from a policy and its file; returns None without lessons."""
        counts = self._collect(number, who)
        self._lessons.add(number)
        if not self._lessons.are_new:
            messages.indented("nothing to learn from")
            return None
        return self._lessons.train(number, before), counts

    def _collect(self, number: int, who: PolicyInEnv) -> dict[str, Any]:
        """Runs the trials of a round with the policy of the round before; returns their counts."""
        work, root = self._work, self._work.folder(number) / "rollouts"
        print(f"\n[round {number}] rollouts: into {root}", flush=True)
        settings = rounds.RoundSettings(
            number=number - 1,
            seed=work.settings.seed,
            trials=work.settings.trials,
            max_steps=self._max_steps,
            expert=finetune_checks.demonstrator(work.config, work.base.env.task),
            policy=who.weights,
            about={"limits": self._limits._asdict(), "rewinds_s": dagger.REWINDS_S},
        )
        with stage_times.timed(work.out, f"round {number} rollouts"):
            outcomes = rounds.collect(
                root,
                work.base.env,
                work.seen,
                self._way(who),
                settings,
                layout=placement.DeviceLayout(devices=placement.devices()),
                report=messages.indented,
            )
        count, learned = len(outcomes.trial), int(outcomes.kept.sum())
        messages.indented(f"{count} trials, {learned} of them are learned")
        won = statistics.rate(outcomes.success[:, 0])
        takeovers = finetune_counts.report(outcomes)
        return {"trials": count, "learned": learned, "success": won, **takeovers}

    def _way(self, who: PolicyInEnv) -> rounds.Way:
        trained, settings = who.trained, who.trained.policy
        params = (trained.params, trained.normalizer)
        expert = finetune_checks.demonstrator(self._work.config, who.env.task)
        hz = who.env.control_hz
        return dagger.way(who.agent(), params, who.env.task, expert, settings, self._limits, hz)


def one_step_policy(work: Work, settings: config_lib.PolicyConfig) -> policies.Policy:
    """Returns the policy of a round with other settings."""
    env, method = work.base.env, work.stored.method
    cameras = env.names.cameras
    return policies.make(methods.METHODS[method], settings, env.task, work.config.train, cameras)


class Lessons:
    """Demonstrations and the rollouts of all rounds so far; images wait until they are learned."""

    def __init__(self, work: Work):
        """Loads the demonstrations; collects them unless the run has today's."""
        policy = work.config.policy
        self._work, self._encoder = work, None
        self._rollouts: list[tuple[mixing.Part, np.ndarray]] = []
        if policy.observation == "image" and policy.freeze_encoder:
            vision = work.stored.params["vision"]
            self._encoder = Encoder(vision, policy_file.fingerprint(vision)[:16])
        config, env = work.config, work.base.env
        plan = demonstrations.plan(config, env, work.share)
        if not store.is_sealed(plan.root):
            config = dataclasses.replace(config, out=str(work.out))
            plan = demonstrations.plan(config, env, work.share)
        demonstrations.complete(config, plan.root, plan.collect, work.share)
        self._demonstrations = self._part(plan.root, config, verify=False)
        if work.settings.interventions:
            self._add(interventions.find(work.settings, work.base.env, work.seen))

    def demonstrations(self) -> windows.Dataset:
        """Returns those of the policy's training, on the device if they fit."""
        return mixing.joined([self._demonstrations])

    @property
    def are_new(self) -> bool:
        """True once some rollout teaches something."""
        return bool(self._rollouts)

    def add(self, number: int) -> None:
        """Loads the learned episodes of a round."""
        root = self._work.folder(number) / "rollouts"
        if store.keys(root):
            self._add(root)

    def _add(self, root: Path) -> None:
        work = self._work
        # Every frame of a rollout may be learned.
        train = dataclasses.replace(work.config.train, window_stride=1)
        config = dataclasses.replace(work.config, train=train, out=str(work.out))
        part = self._part(root, config, verify=True)
        learned = store.read_description(root)["learned"]
        self._rollouts.append((part, mixing.learned_frames(load.actors(root), learned)))

    def _part(self, root: Path, config: config_lib.RunConfig, verify: bool) -> mixing.Part:
        """Loads a dataset without its images."""
        env = self._work.base.env if config.policy.observation == "image" else None
        loaded = load.load(
            root,
            residency="host",
            verify=verify,
            images=False,
            env=env,
            sources=randomise.redraws(config.train),
            report=lambda line: None,  # the whole is reported once it is placed
        )
        if self._encoder is not None:
            dataset = demonstrations.with_features(config, env, root, loaded, self._encoder)
            return mixing.Part(dataset)
        images = load.frames(root, env) if env is not None else {}
        return mixing.Part(loaded.dataset, images)

    def train(self, number: int, before: Path) -> Path:
        """Trains on from the weights of a file; returns the file of the new ones."""
        work, folder = self._work, self._work.folder(number)
        file, config = folder / "policy.safetensors", work.config
        if file.exists():
            return file
        old = policy_file.load(before)
        print(f"\n[round {number}] train: into {folder}", flush=True)
        with stage_times.timed(work.out, f"round {number} training"), stop_signals() as should_stop:
            row, task = methods.METHODS[old.method], work.base.env.task
            dataset, start = mixing.start(
                row,
                config.policy,
                config.train,
                old.params,
                old.normalizer,
                self._demonstrations,
                self._rollouts,
                normalizer.wrist_of(row, task),
                messages.indented,
            )
            result = loop.run(
                row,
                config.policy,
                config.train,
                dataset,
                task,
                folder,
                (work.settings.seed + number) % 2**32,
                cameras=work.base.env.names.cameras,
                should_stop=should_stop,
                description=f"Round {number}",
                draw_images=pipeline.draw_images(config, work.base.env),
                start=start,
            )
        state = processes.own(result.state)
        params = state.ema_params
        if self._encoder is not None:
            params = {**params, "vision": self._encoder.params}
        # A monitor belongs to the parameters that it was calibrated with.
        new = old._replace(params=params, normalizer=state.normalizer, monitor=None)
        policy_file.save(file, new)
        return file
