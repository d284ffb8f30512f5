"""Compiles the programs of a run beside the stages before them: each keeps one core busy."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from starjax import config as config_lib
from starjax import methods
from starjax.commands import stage_times
from starjax.runtime import background


def _nothing() -> None:
    return None


class Ahead(NamedTuple):
    """What is being compiled; each waits for it, and is None where there is nothing to be had.

    Attributes:
      step: `training.stepper.Compiled` of the first training.
      evaluation: `policy_evaluation.Programs` of the first method.
    """

    step: Callable[[], Any] = _nothing
    evaluation: Callable[[], Any] = _nothing


def begin(
    config: config_lib.RunConfig, name: str, stages: Sequence[str], env: Any, encoder: Any
) -> Ahead:
    """Begins to compile what a method that is not trained yet will need: its step, then its trials.

    Args:
      config: of the run.
      name: of the method.
      stages: that are to be done.
      env: with the observation that it is trained on.
      encoder: the frozen one, None where it has none.
    """
    import jax

    from starjax.commands import policy_evaluation
    from starjax.training import ahead as training

    if "train" not in stages or len(jax.devices()) > 1:
        return Ahead()
    row = methods.METHODS[methods.METHODS[name].weights_of]

    def compile_step() -> Any:
        # What a frozen encoder sees is not a batch's picture.
        if encoder:
            return None
        cameras = env.names.cameras
        return training.compile_step(row, config.policy, config.train, env.task, cameras)

    def compile_evaluation() -> Any:
        if "evaluate" not in stages:
            return None
        step()
        vision = encoder.params if encoder else None
        return policy_evaluation.compile_ahead(name, config, env, vision)

    step = background.run_in_background(lambda: _apart(compile_step))
    return Ahead(step, background.run_in_background(lambda: _apart(compile_evaluation)))


def _apart(work: Callable[[], Any]) -> Any:
    """What `work` gives, its time counted for no stage; None if it fails.

    A mistake shows again where the program is run.
    """
    try:
        with stage_times.apart():
            return work()
    except Exception:
        return None
