"""The beginning of a training: its data and parameters, or the checkpoint that it continues."""

import pathlib
from typing import Any, NamedTuple

import jax
import numpy as np

from starjax.core import config, errors, methods
from starjax.data import normalizer, stillness, windows
from starjax.policies import features
from starjax.policies import policy as policies
from starjax.runtime import processes
from starjax.sim.task import Task
from starjax.training import checkpoint, encoder
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


def observed(
    dataset: windows.Dataset, policy_config: config.PolicyConfig, seen: features.Sensors
) -> windows.Dataset:
    """Removes observations that the policy does not use: gathering them would take time."""
    observation = dataset.observation
    kept = "images" if policy_config.observation == "image" else "state"
    kept = "features" if policy_config.freeze_encoder else kept
    images = {name: (observation.images or {}).get(name) for name in seen.cameras}
    unseen = {name: None for name in ("images", "state", "features", "endoscope") if name != kept}
    return dataset.replace(observation=observation._replace(**{"images": images, **unseen}))


def restored(checkpoints: pathlib.Path, shapes: Any) -> states.TrainState | None:
    """Returns the state of the newest sound checkpoint, None without one."""
    restored = checkpoint.restore(checkpoints, shapes) if checkpoint.steps(checkpoints) else None
    step = -1 if restored is None else restored[0]
    if processes.agree(step) != (step,):
        raise errors.UsageError(
            str(checkpoints.parent), "a folder that all processes share", "other checkpoints in it"
        )
    return None if restored is None else restored[1]


def check_same(
    directory: pathlib.Path,
    state: states.TrainState,
    key: jax.Array,
    stats: normalizer.Normalizer,
    steps: int,
) -> None:
    """Raises UsageError for a state of another training."""
    if not np.array_equal(jax.random.key_data(state.key), jax.random.key_data(key)):
        raise errors.UsageError("seed", f"that of the training in {directory}", "another")
    if not all(map(_alike, jax.tree.leaves(state.normalizer), jax.tree.leaves(stats))):
        raise errors.UsageError(
            "the demonstrations", f"those of the training in {directory}", "others"
        )
    if int(state.step) > steps:
        done = f"{state.step} or more, which the training in {directory} has done"
        raise errors.UsageError("train.steps", done, steps)


def _alike(one: Any, other: Any) -> bool:
    """Returns True for statistics of the same data; last bits vary between processors."""
    return np.shape(one) == np.shape(other) and np.allclose(one, other, rtol=1e-5, atol=1e-6)
