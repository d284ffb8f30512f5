"""Demonstrations and rollouts as one dataset, and the start of a training on both.

Batches are drawn from both parts by an even coin: the frames of the smaller part are repeated. So
steps, losses and learners are those of any training. A few rollouts count for less.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from starjax import config, errors, methods, rcm
from starjax.data import normalizer, redraw, windows
from starjax.policies import policy as policies
from starjax.rollouts import takeover
from starjax.training.start import Start

MAX_REPEATS = 20  # of a frame for one of the larger part: more would be remembered, not learned


def joined(datasets: Sequence[windows.Dataset]) -> windows.Dataset:
    """Returns the frames of several datasets, one after another.

    Raises:
      errors.UsageError: images of some do not fit the memory, and are read or drawn when indexed.
    """
    if not all(isinstance(x, np.ndarray | jax.Array) for x in jax.tree.leaves(list(datasets))):
        expected = "frames that fit the device's or the host's memory"
        raise errors.UsageError("the demonstrations", expected, "more")
    counts = [int(np.sum(dataset.length)) for dataset in datasets]
    resident = all(map(windows.on_device, datasets))
    rows = windows.padded_count(sum(counts)) if resident else sum(counts)
    concatenate, pad = (jnp.concatenate, jnp.pad) if resident else (np.concatenate, np.pad)

    def of_frames(*leaves):
        whole = concatenate([leaf[:count] for leaf, count in zip(leaves, counts)])
        return pad(whole, [(0, rows - len(whole)), *[(0, 0)] * (whole.ndim - 1)])

    demos = [len(dataset.start) for dataset in datasets]
    first_frame, first_demo = (
        np.cumsum(x, dtype=np.int32) - np.asarray(x, np.int32) for x in (counts, demos)
    )
    return windows.Dataset(
        observation=jax.tree.map(of_frames, *(dataset.observation for dataset in datasets)),
        command=jax.tree.map(of_frames, *(dataset.command for dataset in datasets)),
        trocar=jax.tree.map(lambda *x: concatenate(x), *(dataset.trocar for dataset in datasets)),
        episode=of_frames(*(d.episode + shift for d, shift in zip(datasets, first_demo))),
        start=concatenate([d.start + shift for d, shift in zip(datasets, first_frame)]),
        length=concatenate([dataset.length for dataset in datasets]),
        sources=_joined_sources(datasets, counts, rows),
    )


def _joined_sources(
    datasets: Sequence[windows.Dataset], counts: Sequence[int], rows: int
) -> redraw.Sources | None:
    """Returns the sources of the images of all frames, or None if a dataset lacks them."""
    found = [dataset.sources for dataset in datasets]
    if any(sources is None for sources in found):
        return None
    qpos = np.concatenate([np.asarray(s.qpos[:count]) for s, count in zip(found, counts)])
    episodes = jax.tree.map(lambda *x: jnp.concatenate(x), *(s.episodes for s in found))
    return redraw.Sources(np.pad(qpos, ((0, rows - len(qpos)), (0, 0))), episodes)


def learned_frames(actor: np.ndarray, source: str) -> np.ndarray:
    """Returns the frames whose commands are learned, int32.

    Args:
      actor: `[F]` of a dataset, see `episodes.FIELDS`.
      source: of its episodes; interventions teach an expert's or a person's frames alone.
    """
    is_learned = actor > takeover.POLICY if source == "intervention" else np.ones(len(actor), bool)
    return np.flatnonzero(is_learned).astype(np.int32)


def evenly(demonstrated: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Returns frames of which `demonstrated` and others are drawn equally often.

    Unless that repeats a frame more than `MAX_REPEATS` times.
    """
    count = max(len(demonstrated), len(others))
    parts = (np.resize(x, min(count, MAX_REPEATS * len(x))) for x in (demonstrated, others))
    return np.concatenate(list(parts))


def with_reach(stats: normalizer.Normalizer) -> normalizer.Normalizer:
    """Returns the normaliser with its action's `reach` in numbers: rounds share their programs."""
    if stats.action.reach is not None:
        return stats
    ones = jnp.ones_like(stats.action.low)
    return stats.replace(action=stats.action.replace(reach=jnp.stack([-ones, ones])))


def widened(
    stats: normalizer.Normalizer,
    method: methods.Method,
    dataset: windows.Dataset,
    frames: np.ndarray,
    wrist: rcm.Wrist | None = None,
) -> normalizer.Normalizer:
    """Returns the normaliser with a `reach` that includes the commands at `frames`.

    Its scale stays, which the networks were trained with. Samples end at `reach`: without it a
    policy could not say a recovery outside the demonstrated box.
    """
    box = with_reach(stats).action

    @jax.jit
    def ends(command, trocar):
        pose, gripper, angles = command
        scaled = box.normalize(
            normalizer.encode(method.action_space, pose, gripper, trocar, wrist, angles)
        )
        return jnp.stack([scaled.min(axis=0), scaled.max(axis=0)])

    found = windows.over_frames(dataset, frames, lambda _, *rest: ends(*rest))
    low, high = np.minimum(box.reach[0], found.min(0)), np.maximum(box.reach[1], found.max(0))
    return stats.replace(action=box.replace(reach=jnp.asarray(jnp.stack([low, high]))))


def start(
    method: methods.Method,
    policy_config: config.PolicyConfig,
    train_config: config.TrainConfig,
    params: policies.Params,
    stats: normalizer.Normalizer,
    demonstrations: windows.Dataset,
    rollouts: Sequence[tuple[windows.Dataset, np.ndarray]],
    wrist: rcm.Wrist | None = None,
) -> tuple[windows.Dataset, Start]:
    """Returns the dataset of a round and the start of its training.

    Args:
      method: row of the policy.
      policy_config: its settings.
      train_config: of this training.
      params: averaged ones of the policy.
      stats: its normaliser.
      demonstrations: of its training.
      rollouts: datasets of the rounds so far, and the frames `[n]` of each that are learned.
      wrist: that the policy commands, see `normalizer.wrist_of`.
    """
    demonstrated, held_out = windows.split_holdout(
        demonstrations.start,
        demonstrations.length,
        demonstrations.trocar,
        train_config.holdout_demos,
    )
    parts = [demonstrations, *(part for part, _ in rollouts)]
    first = np.cumsum([int(np.sum(part.length)) for part in parts], dtype=np.int32)
    others = np.concatenate([frames + at for (_, frames), at in zip(rollouts, first)])
    demonstrated, held_out = (
        windows.strided(demonstrations, part, train_config.window_stride)
        for part in (demonstrated, held_out)
    )
    if policy_config.freeze_encoder:
        params = {name: part for name, part in params.items() if name != "vision"}
    dataset = joined(parts)
    stats = widened(stats, policies.ablated(method, policy_config), dataset, others, wrist)
    return dataset, Start(stats, evenly(demonstrated, others), held_out, params)
