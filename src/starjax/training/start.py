"""The beginning of a training: statistics, frames, and parameters, drawn or of another training."""

from typing import NamedTuple

import numpy as np

from starjax.core import config, methods
from starjax.data import normalizer, stillness, windows
from starjax.policies import policy as policies
from starjax.sim.task import Task
from starjax.training import encoder
from starjax.training import state as states


class Start(NamedTuple):
    """Statistics and frames of a training, and perhaps the parameters that it continues.

    Attributes:
      stats: the policy's normaliser.
      frames: `[n]` frame numbers; a repeated one is drawn more often.
      held_out: `[m]` frame numbers that measure the action error.
      params: in the structure of `Policy.init`, or None for drawn ones.
    """

    stats: normalizer.Normalizer
    frames: np.ndarray
    held_out: np.ndarray
    params: policies.Params | None = None


def fitted(
    method: methods.Method,
    policy_config: config.PolicyConfig,
    train_config: config.TrainConfig,
    dataset: windows.Dataset,
    task: Task,
) -> Start:
    """Returns the start of a new policy on a dataset; the arguments are those of `loop.run`."""
    frames, held_out = windows.split_holdout(
        dataset.start, dataset.length, dataset.trocar, train_config.holdout_demos
    )
    row = policies.ablated(method, policy_config)
    stats = normalizer.fit(row, task, dataset, frames)
    frames = stillness.skipped(dataset, frames, train_config.skip_still)
    frames, held_out = (
        windows.strided(dataset, kept, train_config.window_stride) for kept in (frames, held_out)
    )
    return Start(stats, frames, held_out)


def first_params(drawn: policies.Params, policy_config: config.PolicyConfig) -> policies.Params:
    """Returns a new training's parameters, with the encoder that the settings name."""
    params = states.on_device(drawn)
    learns_to_see = policy_config.observation == "image" and not policy_config.freeze_encoder
    if learns_to_see and policy_config.encoder_weights:
        params = encoder.start(params, policy_config)
    return params
