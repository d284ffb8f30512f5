"""About how long a run takes, from runs that were timed."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from starjax import config as config_lib
from starjax import methods
from starjax.commands import folders, presets


class Stage(NamedTuple):
    """A stage that was timed.

    Attributes:
      count: demonstrations, training steps or trials.
      seconds: for all of them.
      compiling: seconds of these in which jax compiled, which do not grow with the count.
    """

    count: int
    seconds: float
    compiling: float

    def expected(self, count: int) -> float:
        """Seconds for another count; none for nothing."""
        return self.compiling + (self.seconds - self.compiling) * count / self.count if count else 0


class Timed(NamedTuple):
    """A run of a preset, with method stardiff.

    Attributes:
      machine: in words, and backend: as jax calls it.
      source: its result below experiments/, which a test holds these figures to.
      collect, features, train, evaluate: its stages.
      beside: s of its start, its small programs and its report: what the clock said beside stages.
    """

    machine: str
    backend: str
    source: str
    collect: Stage
    features: Stage
    train: Stage
    evaluate: Stage
    beside: float


TIMED = {
    "cpu": Timed(
        machine="2 cores of an AMD EPYC",
        backend="cpu",
        source="cpu_main_job/result.json",
        collect=Stage(240, 148.93, 41.01),
        features=Stage(240, 38.04, 0.33),
        train=Stage(3_000, 142.89, 23.79),
        evaluate=Stage(72, 30.67, 0.45),
        beside=13.0,
    ),
    "gpu": Timed(
        machine="an NVIDIA H100 with 16 cores",
        backend="gpu",
        source="gpu_main_job/flow_again.json",
        collect=Stage(800, 90.47, 51.4),
        features=Stage(0, 0.0, 0.0),
        train=Stage(8_000, 73.98, 26.21),
        evaluate=Stage(360, 11.35, 4.72),
        beside=59.0,
    ),
}


def seconds(config: config_lib.RunConfig, stages: Sequence[str], trocars: int) -> float | None:
    """Seconds that a run takes from nothing on a machine that was timed.

    Args:
      config: settings of the run.
      stages: some of collect, train, evaluate.
      trocars: configurations that are evaluated.

    Returns None for other networks, batches and scenes than were timed.
    """
    usual, timed = presets.PRESETS.get(config.preset), TIMED.get(config.preset)
    if usual is None or timed is None or config.scene.task != usual.scene.task:
        return None
    if config.demos.from_:  # nobody has said how many
        return None
    networks = [(each.policy, each.train.batch_size) for each in (config, usual)]
    if {"train", "evaluate"} & {*stages} and networks[0] != networks[1]:
        return None
    names = folders.selected(config)
    weights = {methods.METHODS[name].weights_of for name in names}
    demonstrations = config.demos.per_trocar * config.demos.seen_trocars
    spent = timed.collect.expected(demonstrations) if "collect" in stages else 0.0
    if "train" in stages:
        spent += timed.features.expected(demonstrations) if config.policy.freeze_encoder else 0.0
        spent += len(weights) * timed.train.expected(config.train.steps)
    if "evaluate" in stages:
        spent += len(names) * timed.evaluate.expected(trocars * config.eval.trials)
    return spent + timed.beside


def line(
    config: config_lib.RunConfig,
    stages: Sequence[str],
    trocars: int,
    backend: str,
    pace: Callable[[], float],
) -> str:
    """Estimated time, as the plan says it; on a CPU the time is this machine's, by its `pace`."""
    timed, spent = TIMED.get(config.preset), seconds(config, stages, trocars)
    if timed is None or spent is None or timed.backend != backend:
        return "not known for these settings; each stage's bar says it after some steps"
    there = f"about {_minutes(spent)} from the start on {timed.machine}"
    return there if backend != "cpu" else f"about {_minutes(spent * pace())} here; {there}"


def _minutes(spent: float) -> str:
    return f"{max(1, round(spent / 60))} min"
