"""Demonstrations and rollouts as one dataset, and the start of a training on both.

Batches are drawn from both parts by an even coin: the frames of the smaller part are repeated. So
steps, losses and learners are those of any training. A few rollouts count for less.
"""

import functools
import math
import types
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.core import config, methods
from starjax.data import load, normalizer, placed_images, redraw, windows
from starjax.policies import policy as policies
from starjax.runtime import files
from starjax.sim.rollouts import takeover
from starjax.training.start import Start

MAX_REPEATS = 5  # uses of a frame of the smaller part: more would be remembered, not learned


class Part(NamedTuple):
    """Demonstrations, or the rollouts of a round.

    Attributes:
      dataset: in host memory, without images.
      images: by camera, read or drawn when indexed; empty for a policy that reads none.
    """

    dataset: windows.Dataset
    images: Mapping[str, placed_images.Images] = types.MappingProxyType({})


def joined(
    parts: Sequence[Part], report: Callable[[str], None] = lambda line: None
) -> windows.Dataset:
    """Returns the frames of all parts, one after another, on the device if they fit.

    Images exist once: those of all parts are read or drawn into one array.

    Args:
      parts: with images of the same cameras.
      report: gets a line with the place and the bytes, before any is allocated.
    """
    datasets = [part.dataset for part in parts]
    counts = [int(np.sum(dataset.length)) for dataset in datasets]
    demos = [len(dataset.start) for dataset in datasets]
    first_frame, first_demo = (
        np.cumsum(x, dtype=np.int32) - np.asarray(x, np.int32) for x in (counts, demos)
    )
    images = {
        camera: placed_images.JoinedImages([part.images[camera] for part in parts])
        for camera in parts[0].images
    }
    total = sum(math.prod(image.shape) for image in images.values())
    total += sum(leaf.nbytes for leaf in jax.tree.leaves(datasets))
    place = load.place_for(total)
    rows = windows.padded_count(sum(counts)) if place == "device" else sum(counts)
    is_drawn = any(isinstance(x, redraw.DrawnImages) for x in parts[0].images.values())
    report(f"{sum(demos)} episodes, {files.size(total)}: {load.whereabouts(place, is_drawn)}")

    def of_frames(*leaves):
        whole = np.concatenate(leaves)
        return np.pad(whole, [(0, rows - len(whole)), *[(0, 0)] * (whole.ndim - 1)])

    of_demos = functools.partial(jax.tree.map, lambda *x: np.concatenate(x))
    observation = jax.tree.map(of_frames, *(dataset.observation for dataset in datasets))
    shown = {camera: image.at(place, rows) for camera, image in images.items()}
    dataset = windows.Dataset(
        observation=observation._replace(images=shown or None),
        command=jax.tree.map(of_frames, *(dataset.command for dataset in datasets)),
        trocar=of_demos(*(dataset.trocar for dataset in datasets)),
        episode=of_frames(*(d.episode + shift for d, shift in zip(datasets, first_demo))),
        start=np.concatenate([d.start + shift for d, shift in zip(datasets, first_frame)]),
        length=np.concatenate([dataset.length for dataset in datasets]),
        sources=_joined_sources(datasets, rows),
    )
    return jax.device_put(dataset) if place == "device" else dataset


def _joined_sources(datasets: Sequence[windows.Dataset], rows: int) -> redraw.Sources | None:
    """Returns the sources of the images of all frames, or None if a dataset lacks them."""
    found = [dataset.sources for dataset in datasets]
    if any(sources is None for sources in found):
        return None
    qpos = np.concatenate([np.asarray(sources.qpos) for sources in found])
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
    demonstrations: Part,
    rollouts: Sequence[tuple[Part, np.ndarray]],
    wrist: rcm.Wrist | None = None,
    report: Callable[[str], None] = lambda line: None,
) -> tuple[windows.Dataset, Start]:
    """Returns the dataset of a round and the start of its training.

    Args:
      method: row of the policy.
      policy_config: its settings.
      train_config: of this training.
      params: averaged ones of the policy.
      stats: its normaliser.
      demonstrations: of its training.
      rollouts: of the rounds so far, and the frames `[n]` of each that are learned.
      wrist: that the policy commands, see `normalizer.wrist_of`.
      report: gets a line about the dataset.
    """
    demos = demonstrations.dataset
    demonstrated, held_out = windows.split_holdout(
        demos.start, demos.length, demos.trocar, train_config.holdout_demos
    )
    parts = [demonstrations, *(part for part, _ in rollouts)]
    first = np.cumsum([int(np.sum(part.dataset.length)) for part in parts], dtype=np.int32)
    others = np.concatenate([frames + at for (_, frames), at in zip(rollouts, first)])
    demonstrated, held_out = (
        windows.strided(demos, part, train_config.window_stride)
        for part in (demonstrated, held_out)
    )
    if policy_config.freeze_encoder:
        params = {name: part for name, part in params.items() if name != "vision"}
    dataset = joined(parts, report)
    stats = widened(stats, policies.ablated(method, policy_config), dataset, others, wrist)
    return dataset, Start(stats, evenly(demonstrated, others), held_out, params)
