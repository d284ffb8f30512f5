"""A fine-tuning at work: its policy, settings and directory.

<out>/plan.json              settings and weights; other ones are refused
<out>/demos-<digest>/        demonstrations, unless the run has them
<out>/round_0/validation/    trials of the policy itself
<out>/round_<n>/rollouts/    trials and dataset of a round, see `rounds`
<out>/round_<n>/...          checkpoints, policy.safetensors, validation
<out>/before/, <out>/after/  results on all trocars
<out>/policy.safetensors     the best round's
<out>/finetune.json          success of every round, before and after
"""

import dataclasses
import math
import time
from pathlib import Path
from typing import Any, NamedTuple

from starjax.addons.finetune import mixing
from starjax.addons.finetune.commands import finetune_checks
from starjax.addons.finetune.settings import FinetuneConfig
from starjax.cli import policy_args, session
from starjax.core import config as config_lib
from starjax.core import errors
from starjax.policies import in_env, policy_file
from starjax.policies.in_env import PolicyInEnv
from starjax.rcm.trocar import Trocar
from starjax.runtime import files
from starjax.sim.rollouts import trocars
from starjax.sim.rollouts.sharing import Share

_WARMUP = 500  # training steps, in which the new optimiser's averages settle
_DIGITS = 12  # for a digest in messages
_MAY_CHANGE = ("rounds", "minutes", "eval")  # settings that may change when a fine-tuning resumes


class Work(NamedTuple):
    """A fine-tuning.

    Attributes:
      settings: of the command.
      config: of the policy's run, with the training settings of a round.
      file: the policy.
      stored: its content.
      base: the policy in its environment.
      seen: trocars of rollouts and validation, those of the demonstrations.
      started: the session.
      share: of this process.
      deadline: of `time.monotonic`, s, after which no round begins.
    """

    settings: FinetuneConfig
    config: config_lib.RunConfig
    file: Path
    stored: policy_file.Trained
    base: PolicyInEnv
    seen: Trocar
    started: session.Session
    share: Any
    deadline: float

    @property
    def out(self) -> Path:
        """Directory of the results."""
        return self.started.folder

    def folder(self, number: int) -> Path:
        """Returns the directory of a round; 0 is the policy itself."""
        return self.out / f"round_{number}"

    def is_late(self) -> bool:
        """Returns True once the time is up."""
        return time.monotonic() > self.deadline

    def is_trained(self, number: int) -> bool:
        """Returns True if a round has its policy."""
        return (self.folder(number) / "policy.safetensors").exists()

    def place(self, file: Path) -> PolicyInEnv:
        """Returns the policy of a round in the environment; all rounds share their programs."""
        return in_env.place(file, in_env.read(file), self.base.env, policy=self.base.policy)


def begin(
    settings: FinetuneConfig, path: policy_args.PolicyPath, started: session.Session, share: Share
) -> Work:
    """Reads the policy and claims the directory.

    Raises:
      errors.UsageError: the directory is of other settings, another method has the weights, or
        the way does not suit the policy.
    """
    base, config = policy_args.load(path)
    stored = policy_file.load(path.file)
    if stored.method != base.trained.method:
        got = f"{base.trained.method}, which runs those of {stored.method}"
        raise errors.UsageError("RUN", "a method with weights of its own", got)
    seen = trocars.select(base.env.task.trocars, slice(config.demos.seen_trocars))
    finetune_checks.check(settings, config, stored.policy, base.env, seen)
    share.first("claimed", lambda: _claim(started.folder, settings, base.weights))
    stats = mixing.with_reach(base.trained.normalizer)
    return Work(
        settings=settings,
        config=_round_config(settings, config, stored, started.folder, path.run),
        file=path.file,
        stored=stored,
        base=base._replace(trained=base.trained._replace(normalizer=stats)),
        seen=seen,
        started=started,
        share=share,
        deadline=time.monotonic() + 60.0 * (settings.minutes or math.inf),
    )


def _round_config(
    settings: FinetuneConfig,
    config: config_lib.RunConfig,
    stored: policy_file.Trained,
    out: Path,
    run: Path | None,
) -> config_lib.RunConfig:
    """Returns the settings of a policy's run with those of a round's training."""
    train = dataclasses.replace(
        stored.train,
        steps=settings.steps,
        learning_rate=settings.rate * stored.train.learning_rate,
        warmup_steps=_WARMUP,
        checkpoint_every=min(stored.train.checkpoint_every, settings.steps),
    )
    return dataclasses.replace(
        config,
        seed=settings.seed if run is None else config.seed,  # no policy file has its seed
        out=str(out if run is None else run.parent),
        policy=_round_policy(settings, stored.policy),
        train=train,
        eval=settings.eval,
    )


def _round_policy(settings: FinetuneConfig, policy: config_lib.PolicyConfig) -> Any:
    """Returns a policy's settings in a round; some ways freeze the encoder and use float32."""
    if settings.by not in finetune_checks.OF_ONE_STEP:
        return dataclasses.replace(policy, dtype=settings.dtype)
    is_frozen = policy.observation == "image"
    return dataclasses.replace(policy, dtype="float32", freeze_encoder=is_frozen)


def _claim(folder: Path, settings: FinetuneConfig, weights: str) -> None:
    """Records settings and weights; refuses a directory of others."""
    names = [field.name for field in dataclasses.fields(FinetuneConfig)]
    values = {name: getattr(settings, name) for name in names if name not in _MAY_CHANGE}
    plan = {"weights": weights, **values}
    try:
        before = files.read_json(folder / "plan.json")
    except (FileNotFoundError, ValueError):
        before = {}
    for name, value in plan.items():
        if before.get(name, value) != value:
            hint = "choose another folder by --out, or remove that one"
            argument, was, now = name, before[name], value
            if name == "weights":
                argument, was, now = "RUN", f"the policy {was[:_DIGITS]}", now[:_DIGITS]
            raise errors.UsageError(argument, f"{was}, with which {folder} was made", now, hint)
    files.write_json(folder / "plan.json", plan)
