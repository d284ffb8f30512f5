"""Trocars of imported episodes: read from a column, or estimated from the motion."""

from typing import Any

import numpy as np

from starjax import rcm
from starjax.addons.formats.mapping import Map
from starjax.addons.formats.motion import Motion
from starjax.data import shafts

SAME = 1e-3  # m; trocars that lie closer are one
MISSED = 5e-3  # m; shafts that pass the trocar so far (root mean square) have another axis or frame
_SIZE = 64  # episodes of which the trocar of a whole dataset is estimated

Tips = tuple[np.ndarray, np.ndarray, np.ndarray]  # see `subsample`


def subsample(found: Motion) -> Tips:
    """Keeps of an episode what tells its trocars.

    Some poses of the shafts `[T, A, ...]`, and the trocars `[A, 3]` that the files say, NaN where
    they do not.
    """
    said = np.median(found.p_world_trocar, axis=0)
    return shafts.subsample(found.shaft.R), shafts.subsample(found.shaft.p), said


def locate(
    tips: list[Tips], mapping: Map, numbers: list[int], notes: list[str]
) -> tuple[list[np.ndarray], list[bool]]:
    """Finds every episode's trocars `[A, 3]`, and flags for those that are determined."""
    if not tips:
        return [], []
    said = np.array([trocar for *_, trocar in tips])
    if np.isfinite(said).all():
        return list(said), [True] * len(tips)
    if mapping.trocars == "dataset":
        few = [tips[i] for i in np.linspace(0, len(tips) - 1, min(len(tips), _SIZE)).astype(int)]
        whole = [np.concatenate(field) for field in zip(*((R, p) for R, p, _ in few))]
        each = [shafts.estimate(*whole)] * len(tips)
    else:
        each = [shafts.estimate(R, p) for R, p, _ in tips]
    places = np.array([one.p_world_trocar for one in each], np.float64)
    is_sure = np.array([one.is_determined for one in each])
    is_said: Any = np.isfinite(said).all(-1)
    places = np.where(is_said[..., None], said, places)
    known: Any = is_said | is_sure
    for number, sure, estimate in zip(numbers, known, each):
        if not sure.all():
            arm = int(np.argmin(sure))
            why = rcm.why_undetermined(rcm.TrocarEstimate(*(x[arm] for x in estimate)))
            notes.append(
                f"episode {number}: arm {arm} does not determine its trocar: {why}; left out"
            )
    return list(places), list(known.all(-1))


def group(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Groups episodes' trocars `[E, A, 3]`: returns group indices `[E]` and means `[C, A, 3]`."""
    firsts, groups = [], []
    for place in places:
        near = [i for i, first in enumerate(firsts) if np.abs(first - place).max() < SAME]
        if not near:
            firsts.append(place)
        groups.append(near[0] if near else len(firsts) - 1)
    groups = np.array(groups)
    return groups, np.stack([places[groups == i].mean(0) for i in range(len(firsts))])


def residual(
    tips: list[Tips], places: np.ndarray, numbers: list[int], notes: list[str]
) -> np.ndarray:
    """Returns the shafts' RMS distance from the trocar `[E, A]` in mm; notes large ones."""
    found = []
    for (R, p, _), place, number in zip(tips, places, numbers):
        off = np.linalg.norm(np.cross(p - place, R[..., 2]), axis=-1)
        rms = np.sqrt(np.mean(off**2, axis=0))
        for arm in np.flatnonzero(rms > MISSED).tolist():
            notes.append(
                f"episode {number}: the shaft of arm {arm} passes its trocar at "
                f"{1e3 * rms[arm]:.0f} mm; is z of tip_turn its axis, and the frame right?"
            )
        found.append(1e3 * rms)
    return np.array(found)
