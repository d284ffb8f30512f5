"""Region of a task's trocars: the ranges of each slot's workspace about its nominal trocar."""

from collections.abc import Sequence

import numpy as np
from jax.typing import ArrayLike

from starjax.core import errors
from starjax.sim import registries
from starjax.sim.task import Task

OUTSIDE = 0.01  # m, from the region: the largest error of `trocar_offset` in a stress test

# Ranges of radius in m, polar angle and azimuth in rad.
Region = Sequence[Sequence[float]]


def of_task(task: Task) -> tuple[Region, ...]:
    """Returns the region of each arm's trocar."""
    spaces = [registries.workspaces.get(slot.workspace) for slot in task.slots]
    return tuple((space.radius, space.polar, space.azimuth) for space in spaces)


def ball(region: Region) -> Region:
    """Returns the ball about the nominal trocar that contains a region."""
    return ((0.0, region[0][1]), (0.0, np.pi), (-np.pi, np.pi))


def clipped(region: Region, offset: np.ndarray) -> np.ndarray:
    """Returns offsets `[..., 3]` m from the nominal trocar with clipped radius and angles."""
    x, y, z = np.moveaxis(np.asarray(offset, np.float64), -1, 0)
    across = np.hypot(x, y)
    (nearest, farthest), (least, most), (low, high) = region
    radius = np.clip(np.hypot(across, z), nearest, farthest)
    polar = np.clip(np.arctan2(across, z), least, most)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    # The nearest equivalent angle: azimuths wrap around.
    off = np.remainder(np.arctan2(y, x) - middle + np.pi, 2 * np.pi) - np.pi
    azimuth = middle + np.clip(off, -half, half)
    around = np.stack([np.cos(azimuth), np.sin(azimuth)], -1) * (radius * np.sin(polar))[..., None]
    return np.concatenate([around, (radius * np.cos(polar))[..., None]], -1)


def check(
    regions: Sequence[Region],
    p_world_ref: ArrayLike,
    p_world_trocar: ArrayLike,
    argument: str = "trocar",
) -> None:
    """Raises UsageError for trocars farther than `OUTSIDE` from their region.

    Args:
      regions: of A arms.
      p_world_ref: `[A, 3]` m, nominal trocars.
      p_world_trocar: `[..., A, 3]` m.
      argument: name of the trocars.
    """
    reference = np.reshape(np.asarray(p_world_ref, np.float64), (-1, 3))
    for arm, region in enumerate(regions):
        places = np.asarray(p_world_trocar, np.float64)[..., arm, :].reshape(-1, 3)
        offset = places - reference[arm]
        distance = np.linalg.norm(offset - clipped(region, offset), axis=-1)
        if not (distance <= OUTSIDE).all():  # NaN too
            worst = int(np.argmax(np.nan_to_num(distance, nan=np.inf)))
            place = ", ".join(f"{value:.4g}" for value in places[worst])
            raise errors.UsageError(
                argument,
                f"x, y, z in m, {_text(region)} of {np.round(reference[arm], 4).tolist()}",
                f"[{place}], {1e3 * distance[worst]:.0f} mm outside",
            )


def _text(region: Region) -> str:
    """Returns the region's ranges, in mm and degrees."""
    radius, (polar, azimuth) = 1e3 * np.array(region[0]), np.rad2deg(np.array(region[1:]))
    return (
        f"{radius[0]:g} to {radius[1]:g} mm, polar {polar[0]:g} to {polar[1]:g}°, "
        f"azimuth {azimuth[0]:g} to {azimuth[1]:g}°"
    )
