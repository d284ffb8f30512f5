"""Settings of a fine-tuning. Imports no jax, as `--help` reads them."""

import dataclasses
from typing import Annotated, Literal

from starjax.core import config as config_lib
from starjax.core.limits import Count, NotNegative, Range


@dataclasses.dataclass(frozen=True, kw_only=True)
class FinetuneConfig:
    """Settings of `starjax finetune`, apart from the policy."""

    # dagger: an expert finishes episodes in trouble, and the policy learns the expert's part; rl: a
    # policy gradient raises strict success; distill: the frozen flow of a policy of onestep teaches
    # it the one step
    by: Literal["dagger", "rl", "distill"] = "dagger"
    # directory of a person's interventions, see starjax teleop --policy; dagger learns them too
    interventions: str = ""
    rounds: Annotated[int, Range(1, 100)] = 3  # rounds of rollouts and training
    # wall-clock minutes, after which no round begins and one of rl ends with its iteration; 0: no
    # limit
    minutes: NotNegative = 0.0
    trials: Count = 1200  # trials per round and seen trocar; not of rl
    steps: Count = 8_000  # training steps per round; not of rl
    iterations: Count = 30  # iterations of rl per round
    # learning rate of rl
    gradient_rate: Annotated[float, Range(0.0, 1.0, "(]")] = 1e-5
    # standard deviation of the displacement of plans in episodes of rl and distill, in normalised
    # actions; rl tries a quarter to twice of it first, and uses the most that success can bear
    noise: Annotated[float, Range(0.0, 1.0, "(]")] = 0.01
    episodes: Count = 1024  # per iteration of rl or round of distill, over all seen trocars
    # learning rate as a fraction of that of the policy's training
    rate: Annotated[float, Range(0.0, 1.0, "(]")] = 0.2
    # arithmetic of the networks in training; inference always uses float32
    dtype: Literal["float32", "bfloat16"] = "bfloat16"
    validation: Count = 60  # trials per seen trocar that choose the best round
    seed: config_lib.Seed = 0  # random seed of everything that is drawn
    # trials of the report, before and after, on all trocars of the task
    eval: config_lib.TrialsConfig = dataclasses.field(default_factory=config_lib.TrialsConfig)


# Two cores take some minutes per round.
ON_CPU = FinetuneConfig(
    trials=30,
    steps=1_500,
    iterations=10,
    episodes=32,
    dtype="float32",
    validation=12,
    eval=config_lib.TrialsConfig(trials=12, time_limit_s=20.0),
)
