"""Facts of an import that contradict each other: units, frames, commands, grippers, trocars."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy import spatial

from starjax.addons.formats import mapping as maps
from starjax.addons.formats import tip_poses
from starjax.addons.formats.mapping import Map
from starjax.addons.formats.motion import Motion
from starjax.addons.formats.trocars import MISSED
from starjax.data import shafts
from starjax.sim import trocar_region
from starjax.sim.task import Task

_LEAST_MOTION = 5e-3  # m; the tips of a demonstration move farther
_STEPS_AWAY = 10.0  # typical steps between a command and the next tip
_LEAST_AWAY = 5e-3  # m; a command nearer to the next tip follows it
_OUTSIDE = 0.02  # m, from the region of a task's trocars
_ELSEWHERE = 0.01  # m; estimates of one trocar in several episodes are nearer to each other
_FEW = 2  # episodes, which may well have a trocar each


def of_commands(found: Motion, mapping: Map) -> Iterator[str]:
    """Yields a note for each arm of an episode whose commands are far from the next tips."""
    steps = np.linalg.norm(np.diff(found.pose.p, axis=0), axis=-1)
    if not len(steps):
        return
    away = np.linalg.norm(found.command.p[:-1] - found.pose.p[1:], axis=-1)
    added = np.linalg.norm(
        found.pose.p[:-1] + found.command.p[:-1] - np.array(mapping.origin) - found.pose.p[1:],
        axis=-1,
    )
    for i, arm in enumerate(mapping.arms):
        distance = float(np.median(away[:, i]))
        most = max(_LEAST_AWAY, _STEPS_AWAY * float(np.median(steps[:, i])))
        if arm.command_position and distance > most:
            is_relative = np.median(added[:, i]) < 0.5 * distance
            why = "; they look relative to the tip" if is_relative else ""
            yield f"commands of arm {i} are {1e3 * distance:.0f} mm from the next tip{why}"


def off_trocar(
    R: np.ndarray, p: np.ndarray, p_world_trocar: np.ndarray, mapping: Map
) -> Iterator[str]:
    """Yields notes on commands whose straight shafts miss the trocars of the motion.

    Args:
      R, p: `[T, A, 3, 3]` and `[T, A, 3]` m, commands of an episode.
      p_world_trocar: `[A, 3]` m.
    """
    rms = np.sqrt(np.mean(np.sum(np.cross(p - p_world_trocar, R[..., 2]) ** 2, -1), axis=0))
    for i, arm in enumerate(mapping.arms):
        is_straight = not isinstance(arm.shaft, maps.ShaftColumns)
        if arm.command_position and is_straight and rms[i] > MISSED:
            yield f"commands of arm {i} miss the trocar by {1e3 * rms[i]:.0f} mm: another frame?"


def of_models(arrays: Mapping[str, np.ndarray], mapping: Map, folder: Path) -> Iterator[str]:
    """Yields notes on joints that move a tip and that no column moves, as those that follow."""
    for i, arm in enumerate(mapping.arms):
        if arm.joints and (still := tip_poses.unmoved(arrays, arm, folder)):
            names = ", ".join(still)
            yield f"joints {names} of {arm.model} move the tip of arm {i}: no column gives them"


def of_dataset(
    tips: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]],
    places: np.ndarray,
    numbers: Sequence[int],
    task: Task,
    is_placed: bool = False,
) -> Iterator[str]:
    """Yields notes on the motion's extent, the shafts' direction and the trocars' places.

    Args:
      tips: of each episode rotations `[T, A, 3, 3]`, positions `[T, A, 3]` m, and the trocars
        `[A, 3]` that the files give, NaN for estimated ones.
      places: `[E, A, 3]` m, trocars.
      numbers: of the episodes.
      is_placed: True if the import moved their mean to the task's, so only distances count.
    """
    extent = max(float(np.ptp(p, axis=0).max()) for _, p, _ in tips)
    if extent < _LEAST_MOTION:
        yield f"no tip moves more than {1e3 * extent:.2g} mm: are units and hz right?"
    for (R, p, _), place, number in zip(tips, places, numbers):
        depth = np.median(np.sum((p - place) * R[..., 2], -1), axis=0)
        for i in np.flatnonzero(depth <= 0.0).tolist():
            yield (
                f"episode {number}: tips of arm {i} lie {-1e3 * depth[i]:.0f} mm before the "
                "trocar: is z of tip_turn distal?"
            )
    for (R, p, trocar), number in zip(tips, numbers):
        if not np.isfinite(trocar).all():
            yield from (f"episode {number}: {line}" for line in _wandering(R, p))
    for i, (slot, region) in enumerate(zip(task.slots, trocar_region.of_task(task))):
        offset = places[:, i] - np.array(slot.p_world_ref)
        within = trocar_region.ball(region) if is_placed else region
        away = np.linalg.norm(offset - trocar_region.clipped(within, offset), axis=-1)
        if (far := away > _OUTSIDE).any():
            yield (
                f"{int(far.sum())} trocars of arm {i} lie up to {1e3 * away.max():.0f} mm outside "
                "the region of the task's: are origin and turn right?"
            )
        is_estimated = [not np.isfinite(trocar[i]).all() for *_, trocar in tips]
        yield from _scattered(places[is_estimated, i], i)


def _wandering(R: np.ndarray, p: np.ndarray) -> Iterator[str]:
    """Yields notes on trocars that differ between an episode's halves."""
    middle = len(p) // 2
    halves = [shafts.estimate(R[rows], p[rows]) for rows in (slice(middle), slice(middle, None))]
    moved = np.linalg.norm(halves[1].p_world_trocar - halves[0].p_world_trocar, axis=-1)
    known = halves[0].is_determined & halves[1].is_determined
    for i in np.flatnonzero(known & (moved > MISSED)).tolist():
        yield (
            f"the trocar of arm {i} differs by {1e3 * moved[i]:.0f} mm between the halves: does "
            "the wall move so far, or is it a wrist that does?"
        )


def _scattered(places: np.ndarray, arm: int) -> Iterator[str]:
    """Yields a note if most episodes have an estimated trocar `[E, 3]` of their own."""
    if len(places) > _FEW:
        distances, _ = spatial.KDTree(places).query(places, k=2)
        alone = distances[:, 1] > _ELSEWHERE
        if 2 * alone.sum() > len(places):
            yield (
                f"the trocar of arm {arm} is elsewhere in {alone.sum()} of {len(places)} episodes, "
                f"over {1e3 * np.ptp(places, axis=0).max():.0f} mm: was it moved between all of "
                "them, or their frame?"
            )


def of_state(arrays: Mapping[str, np.ndarray], mapping: Map, task: Task) -> Iterator[str]:
    """Yields a note if the state has another size than the task's."""
    if mapping.state:
        size, wanted = maps.pick(arrays, mapping.state).shape[1], task.state_size
        if size != wanted:
            yield f"the state has {size} numbers, which task {task.name} has {wanted} of"
