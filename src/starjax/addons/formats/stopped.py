"""Streams that end and leave their last value, or are slower: poses and images that repeat."""

import itertools
from collections.abc import Iterator, Mapping

import numpy as np

from starjax.addons.formats import mapping as maps
from starjax.addons.formats import timing
from starjax.addons.formats.mapping import Map

_LEAST_MOTION = 5e-3  # m, of a command or a tip that moves
_LEAST_CHANGES = 5  # values of a stream whose usual duration is judged
_STOPPED = 0.5, 2.0  # s of equal values while commands or tips move, while other streams change


def poses(arrays: Mapping[str, np.ndarray], times: np.ndarray, mapping: Map) -> Iterator[str]:
    """Yields notes on arms of an episode whose measured values repeat while others change.

    A stream that ended leaves its last value. A resting arm repeats values too, but its commands
    rest with it, and nothing else changes at every step for long.
    """
    measured = [
        maps.pick(arrays, (*maps.listed(arm.position), *maps.listed(arm.rotation)))
        if arm.position
        else maps.pick(arrays, arm.joints)
        for arm in mapping.arms
    ]
    scale = 1e-3 if mapping.units == "mm" else 1.0
    for i, arm in enumerate(mapping.arms):
        is_same = _repeats(measured[i])
        yield from _held(is_same, times, f"the pose of arm {i}")
        first, last = _longest_rest(is_same)
        run, seconds = slice(first, last + 1), times[last] - times[first]
        is_asked = False
        if arm.command_position and arm.command_as != "delta":
            asked = maps.pick(arrays, arm.command_position)[run]
            is_asked = scale * np.ptp(asked, axis=0).max() > _LEAST_MOTION
        others = [rows for k, rows in enumerate(measured) if k != i]
        others += [maps.pick(arrays, arm.gripper)] if arm.gripper else []
        changes = [(np.diff(rows[run], axis=0) != 0.0).any(-1) for rows in others if last > first]
        others_move = any(change.mean() > 0.5 for change in changes)
        if (is_asked and seconds > _STOPPED[0]) or (others_move and seconds > _STOPPED[1]):
            at = times[first] - times[0]
            yield f"the pose of arm {i} repeats for {seconds:.2f} s from {at:.2f} s on"


def _repeats(rows: np.ndarray) -> np.ndarray:
    """Returns flags `[T - 1]` of rows `[T, ...]` that equal those before them."""
    flat = rows.reshape(len(rows), -1)
    return np.array([np.array_equal(a, b) for a, b in itertools.pairwise(flat)], bool)


def _held(is_same: np.ndarray, times: np.ndarray, subject: str) -> Iterator[str]:
    """Yields a note on a stream whose values usually last for longer than clocks may differ."""
    changes = times[1:][~is_same]
    if len(changes) > _LEAST_CHANGES and is_same.mean() > 0.5:
        usual = float(np.median(np.diff(changes)))
        if usual > timing.MOST_APART:
            yield f"{subject} changes every {usual:.2g} s only: another stream's clock?"


def _longest_rest(is_same: np.ndarray) -> tuple[int, int]:
    """Returns first and last row of the longest run of equal rows."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], is_same, [0]])))
    if not len(edges):
        return 0, 0
    starts, ends = edges[::2], edges[1::2]
    most = int(np.argmax(ends - starts))
    return int(starts[most]), int(ends[most])


def images(frames: np.ndarray, times: np.ndarray, tips: np.ndarray, camera: str) -> Iterator[str]:
    """Yields notes if a camera's image repeats while a tip moves, or is slow.

    Args:
      frames: `[T, h, w, 3]`.
      times: `[T]` s.
      tips: `[T, A, 3]` m.
    """
    is_same = _repeats(frames)
    yield from _held(is_same, times, f"the image of camera {camera}")
    first, last = _longest_rest(is_same)
    seconds = times[last] - times[first]
    moved = float(np.ptp(tips[first : last + 1], axis=0).max())
    if seconds > _STOPPED[0] and moved > _LEAST_MOTION:
        yield (
            f"the image of camera {camera} repeats for {seconds:.2f} s from "
            f"{times[first] - times[0]:.2f} s on, a tip moves {1e3 * moved:.0f} mm"
        )
