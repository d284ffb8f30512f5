"""Commands that stand still, where a policy that plans from two frames may wait for ever.

Nothing in such frames shows how long they have lasted. Filters of other projects drop stretches of
`LONG` frames (openpi's of DROID).
"""

import contextlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from starjax.core.types import Command, Pose
from starjax.data.windows import Dataset

TIP, AXIS, JAW = 5e-5, float(np.deg2rad(0.05)), 0.005  # m, rad and opening that count as motion
MOST = 4  # control steps that an expert stands still, before the task's judge begins to settle
RARELY = 0.01  # share of successes that may stand still longer, after a miss
LONG = 7  # control steps
PART = 1e-3  # part of its range in an episode, by which a number of unknown unit moves


def is_still(before: Command, after: Command) -> Any:
    """Returns True `[...]` if no tip, axis or jaw of arms `[..., A]` moves between two commands.

    Works on numpy and on jax arrays alike.
    """
    np_ = jnp if isinstance(after.pose.p, jax.Array) else np
    moved = np_.linalg.norm(after.pose.p - before.pose.p, axis=-1)  # m
    # The angle of a small rotation, without the rounding of an arc cosine near 1.
    turned = np_.linalg.norm(after.pose.R - before.pose.R, axis=(-2, -1)) / np.sqrt(2.0)
    closed = np_.abs(after.gripper - before.gripper)
    return ((moved < TIP) & (turned < AXIS) & (closed < JAW)).all(axis=-1)


def stretches(still: np.ndarray) -> np.ndarray:
    """Returns `[T]` int, the length of the still stretch that each step belongs to, or 0.

    Args:
      still: `[T]` bool.
    """
    lengths = np.zeros(len(still), int)
    edges = np.flatnonzero(np.diff(still, prepend=False, append=False))
    for first, end in edges.reshape(-1, 2):
        lengths[first:end] = end - first
    return lengths


def before_the_end(still: np.ndarray) -> np.ndarray:
    """Returns the stretches `[T]` without that of the end, a final hold."""
    lengths = stretches(still)
    moving = np.flatnonzero(~still)
    # At the end a demonstration may rest: nothing follows that a policy could miss.
    lengths[moving[-1] + 1 if len(moving) else 0 :] = 0
    return lengths


def still_steps(command: Command) -> np.ndarray:
    """Returns True `[T]` for commands `[T, A]` of an episode that are nearly the one before."""
    before, after = (jax.tree.map(lambda x, i=i: x[i : len(x) - 1 + i], command) for i in (0, 1))
    return np.append(False, is_still(before, after))


def of_numbers(values: np.ndarray) -> np.ndarray:
    """Returns the stretches `[T]` of actions `[T, n]` of any kind, without a final hold."""
    moved = np.abs(np.diff(values, axis=0)) > PART * np.ptp(values, axis=0)
    return before_the_end(np.append(False, ~moved.any(axis=-1)))


def of_records(root: Path, records: Iterable[Mapping[str, Any]]) -> list[np.ndarray]:
    """Returns the stretches `[T]` of each readable episode of a starjax dataset at `root`."""
    found = []
    for record in records:
        folder = root / "episodes" / record["key"]
        with contextlib.suppress(OSError, ValueError):  # damage has lines of its own
            R, p, gripper = (
                np.load(folder / f"command_{name}.npy", allow_pickle=False)
                for name in ("R", "p", "gripper")
            )
            found.append(before_the_end(still_steps(Command(Pose(R, p), gripper))))
    return found


def text(stretches: list[np.ndarray]) -> str:
    """Returns the share of frames in long stretches, of all episodes, for readers."""
    if not stretches:
        return "unknown"
    share = np.mean(np.concatenate(stretches) >= LONG)
    waits = ": a policy may wait there" if share > 0.01 else ""
    return f"{share:.1%} of frames stand still for {LONG} or more steps{waits}"


def skipped(dataset: Dataset, frames: np.ndarray, least: int) -> np.ndarray:
    """Returns the frames, of `[n]`, outside stretches of `least` still commands; 0 keeps all."""
    if not least:
        return frames
    command = jax.device_get(dataset.command)
    lengths = np.concatenate(
        [
            before_the_end(still_steps(jax.tree.map(lambda x, s=s, n=n: x[s : s + n], command)))
            for s, n in zip(np.asarray(dataset.start), np.asarray(dataset.length))
        ]
    )
    return frames[lengths[frames] < least]
