"""Compiles the programs of a run during its first stages, which keep the processor's cores free."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax

from starjax.cli import demonstrations, policy_evaluation
from starjax.core import config as config_lib
from starjax.core import methods
from starjax.data import redraw
from starjax.runtime import precompile
from starjax.sim.state import Env
from starjax.training import frozen
from starjax.training import precompile as training
from starjax.training.encoder import Encoder


class Precompiled(NamedTuple):
    """Programs of the first method that is not trained yet.

    Each function waits for the compiler, and returns None if nothing was compiled.

    Attributes:
      step: returns the `precompile.Program` of a training step.
      policy: returns the `policies.Policy` whose trials are compiled.
    """

    step: Callable[[], Any] = lambda: None
    policy: Callable[[], Any] = lambda: None


def begin(
    config: config_lib.RunConfig,
    name: str,
    stages: Sequence[str],
    env: Env,
    encoder: Encoder | None,
) -> Precompiled:
    """Begins to compile the features and the training of a method, then its trials and inference.

    Args:
      config: settings of the run.
      name: the method.
      stages: stages of the run.
      env: environment with the observation of the training.
      encoder: the frozen encoder, or None.
    """
    from starjax.report import scene_view, video

    if "train" not in stages or len(jax.devices()) > 1:
        return Precompiled()
    row = methods.METHODS[methods.METHODS[name].weights_of]
    policy = Precompiled().policy
    demos, rows = demonstrations.size(config, env.task)

    def see(encoder: Encoder) -> None:
        for frames in redraw.precompile(env, demos).values():
            frozen.precompile(encoder, config.policy, frames)

    if encoder and demos:
        precompile.start(functools.partial(see, encoder))
    shapes = env.task, env.names.cameras, demos, rows
    step = precompile.start(
        lambda: training.step_program(row, config.policy, config.train, *shapes)
    )
    if "evaluate" in stages:
        vision = encoder.params if encoder else None
        policy = precompile.start(lambda: policy_evaluation.precompile(name, config, env, vision))
    if "report" in stages:
        precompile.start(lambda: scene_view.precompile_camera(env.names, video.SIZE))
    return Precompiled(step, policy)
