"""First pass over another dataset: motions, trocars and anomalies of the episodes that are kept."""

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from msgspec import structs
from scipy.spatial import transform

from starjax.addons.formats import (
    clocks,
    doubts,
    labels,
    motion,
    ranges,
    selection,
    stopped,
    timing,
    trocars,
)
from starjax.addons.formats import mapping as maps
from starjax.addons.formats.base import Source
from starjax.addons.formats.mapping import Map
from starjax.core import errors
from starjax.data import shafts
from starjax.sim.task import Task

_DOWN = (0.0, 0.0, -1.0)


class Kept(NamedTuple):
    """An episode that is kept: its number in the files, control steps, trocar, success."""

    episode: int
    length: int
    trocar: int
    success: bool


class Survey(NamedTuple):
    """Result of the first pass.

    Attributes:
      kept: episodes, in their order.
      tips: poses of each that tell its trocars, see `trocars.subsample`.
      p_world_trocar: `[E, A, 3]` m, means of groups.
      centres: `[C, A, 3]` m, the groups.
      residual_mm: `[E, A]` root mean square of the shafts' distances from their trocars.
      mapping: with its place resolved to `origin` and `turn`.
      hz: of the files.
      notes: anomalies, one per line.
    """

    kept: list[Kept]
    tips: list[trocars.Tips]
    p_world_trocar: np.ndarray
    centres: np.ndarray
    residual_mm: np.ndarray
    mapping: Map
    hz: float
    notes: list[str]


def prepared(source: Source, mapping: Map, folder: Path) -> tuple[Source, Map]:
    """Returns the source joined at the steps of a mapping, and the mapping with names resolved."""
    mapping = labels.resolve(mapping, source, folder)
    if source.by is not None:
        cameras = [camera.column for camera in mapping.cameras.values()]
        source = source.by([*maps.names(mapping), *cameras])
    return source, mapping


def survey(
    source: Source,
    mapping: Map,
    folder: Path,
    task: Task,
    note: Callable[[int], None] = lambda count: None,
) -> Survey:
    """Reads the numbers of all chosen episodes; those that cannot be read become notes.

    Args:
      folder: of the mapping file, where robots' models lie.
      task: of the mapping.
      note: called with 1 after every episode.

    Raises:
      errors.UsageError: no episode is left; of the first one's error if all have errors.
    """
    hz = mapping.hz or source.hz
    if not hz and not mapping.time:
        times = next(iter(clocks.named(source.columns)), None)
        hint = f'time = "{times}" reads their times' if times else ""
        expected = "steps per second, which the files do not say"
        raise errors.UsageError("--map: hz", expected, "none", hint)
    kept, tips, commands, notes = [], [], [], list(labels.doubts(mapping, source))
    notes += timing.of_rates(source.hz, mapping.hz)
    ends: list[float] = []
    jaws, joints = ranges.Jaws(mapping.arms), ranges.Joints(mapping.arms, folder)
    first_error: errors.UsageError | None = None
    for episode in selection.chosen(source, mapping):
        note(1)
        try:
            arrays, poses = motion.of_episode(source, episode, mapping, hz, folder)
            success = maps.pick(arrays, mapping.success, 1)[-1, 0] if mapping.success else 1.0
            odd = [*poses.notes, *doubts.of_commands(poses, mapping)]
            odd += stopped.poses(arrays, poses.times, mapping)
            jaws.add(arrays)
            joints.add(arrays)
        except timing.Gap as gap:
            notes.append(f"episode {episode}: {gap}; omitted")
            continue
        except errors.UsageError as error:
            line = f"{error.got} in episode {episode}"
            first_error = first_error or errors.UsageError(error.argument, error.expected, line)
            notes.append(f"episode {episode}: {error}; omitted")
            continue
        notes += [f"episode {episode}: {line}" for line in odd]
        if not kept:
            notes += doubts.of_state(arrays, mapping, task)
            notes += doubts.of_models(arrays, mapping, folder)
        tips.append(trocars.subsample(poses))
        R, p = poses.command.R, poses.command.p
        commands.append((shafts.subsample(R), shafts.subsample(p)))
        is_success = bool(success > 0.5) and not selection.is_failure(source, episode)
        ends.append(float(success))
        kept.append(Kept(episode, len(poses.pose.p), -1, is_success))
    if not kept and first_error is not None:
        raise first_error
    places, is_known = trocars.locate(tips, mapping, [k.episode for k in kept], notes)
    kept, places = (list(itertools.compress(items, is_known)) for items in (kept, places))
    tips = list(itertools.compress(tips, is_known))
    commands = list(itertools.compress(commands, is_known))
    if not kept:
        reason = notes[-1] if notes else "no episode"
        hint = "; ".join(labels.doubts(mapping, source))
        raise errors.UsageError("PATH", "demonstrations to keep", reason, hint)
    for k, (R, p), place in zip(kept, commands, places):
        notes += [f"episode {k.episode}: {x}" for x in doubts.off_trocar(R, p, place, mapping)]
    is_placed = mapping.place == "trocar"
    if is_placed:
        mapping, tips, places = _placed(mapping, tips, np.array(places), task)
    groups, centres = trocars.group(np.array(places))
    kept = [k._replace(trocar=int(group)) for k, group in zip(kept, groups)]
    numbers = [k.episode for k in kept]
    residual = trocars.residual(tips, centres[groups], numbers, notes)
    column = ", ".join(maps.listed(mapping.success))
    if min(ends) < 0.0 or max(ends) > 1.0:
        notes.append(f"{column} ends from {min(ends):.3g} to {max(ends):.3g}: is it a success?")
    if not any(k.success for k in kept):
        most = f": {column} ends at {max(ends):.3g} or less, above 0.5 counts" if column else ""
        notes.append(f"no episode is a success{most}")
    notes += [
        *jaws.notes(),
        *joints.notes(),
        *doubts.of_dataset(tips, centres[groups], numbers, task, is_placed),
    ]
    return Survey(kept, tips, centres[groups], centres, residual, mapping, hz, notes)


def _placed(
    mapping: Map, tips: list[trocars.Tips], places: np.ndarray, task: Task
) -> tuple[Map, list[trocars.Tips], list[np.ndarray]]:
    """Moves the mean trocars to the task's, and turns the mean shaft downwards."""
    reference = np.array([slot.p_world_ref for slot in task.slots])
    mean = places.mean(0)
    shaft = np.concatenate([R[..., 2].reshape(-1, 3) for R, *_ in tips]).mean(0)
    # With two arms, the line between their trocars shows the heading.
    mine = [shaft, *(mean[1:] - mean[:-1])]
    ours = [np.array(_DOWN), *(reference[1:] - reference[:-1])]
    weights = [np.inf] + [1.0] * (len(mine) - 1) if len(mine) > 1 else None
    turn = transform.Rotation.align_vectors(np.array(ours), np.array(mine), weights)[0]
    shift = reference.mean(0) - turn.apply(mean.mean(0))
    given = transform.Rotation.from_quat(np.roll(mapping.turn, -1))
    x, y, z, w = (turn * given).as_quat()
    resolved = structs.replace(
        mapping,
        place="files",
        origin=tuple((turn.apply(mapping.origin) + shift).tolist()),
        turn=(float(w), float(x), float(y), float(z)),
    )
    matrix = turn.as_matrix()
    moved = [(matrix @ R, p @ matrix.T + shift, said @ matrix.T + shift) for R, p, said in tips]
    return resolved, moved, list(places @ matrix.T + shift)
