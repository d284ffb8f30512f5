"""How much of where an expert wants its tip the trocar decides: a two-way variance decomposition.

Scenes S are crossed with trocars C: every scene, with everything random of it, is played at every
trocar. What is compared is the wanted position at the same progress G within the same phase.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

POINTS = 20  # fractions of progress at which a phase is looked at
LEAST = 0.5  # fraction of a phase, or s of one without an end, that a trial must have come through
STILL = 1e-5  # m of root mean square below which a position stands still: rounding
RESAMPLES = 1000  # draws of the scenes, for the interval


class Segment(NamedTuple):
    """One passage through a phase.

    Attributes:
      phase: its index. visit: how often the phase was entered before, in this attempt.
      progress: `[T]`, grows. p: `[T, A, 3]` m, wanted positions.
    """

    phase: int
    visit: int
    progress: np.ndarray
    p: np.ndarray


def first_attempt(
    phase: np.ndarray, elapsed: np.ndarray, progress: np.ndarray, p: np.ndarray
) -> list[Segment]:
    """The passages of a trial `[T]` up to where its script starts over.

    Args:
      phase: indices in the order in which a script that never fails goes through them.
      elapsed: s, begins anew with every passage.
      progress, p: see `Segment`.
    """
    begins = np.flatnonzero(np.diff(phase, prepend=-1) | (np.diff(elapsed, prepend=np.inf) < 0))
    found: list[Segment] = []
    for first, after in zip(begins, [*begins[1:], len(phase)], strict=True):
        now, part = int(phase[first]), slice(first, after)
        if found and now < found[-1].phase:
            break
        visit = sum(segment.phase == now for segment in found)
        found.append(Segment(now, visit, progress[part], p[part]))
    return found


def crossed(trials: Sequence[Sequence[list[Segment]]]) -> dict[int, list[np.ndarray]]:
    """Phase -> for each of its visits `[S', C, G, A, 3]`, of the scenes whose trials all came
    through it; phases and visits that fewer than half of the scenes came through are omitted.

    Args:
      trials: segments `[S][C]`.
    """
    by_label = [[{(s.phase, s.visit): s for s in one} for one in scene] for scene in trials]
    found: dict[int, list[np.ndarray]] = {}
    for label in sorted({label for scene in by_label for one in scene for label in one}):
        scenes = [
            [one[label] for one in scene] for scene in by_label if all(label in x for x in scene)
        ]
        scenes = [x for x in scenes if min(segment.progress[-1] for segment in x) >= LEAST]
        if len(scenes) < max(2, len(trials) / 2):
            continue
        ends = [segment.progress[[0, -1]] for scene in scenes for segment in scene]
        first, last = np.max(ends, axis=0)[0], np.min(ends, axis=0)[1]
        grid = np.linspace(first, last, POINTS)
        found.setdefault(label[0], []).append(np.array([[_at(x, grid) for x in s] for s in scenes]))
    return found


def _at(segment: Segment, grid: np.ndarray) -> np.ndarray:
    flat = segment.p.reshape(len(segment.p), -1)
    columns = [np.interp(grid, segment.progress, column) for column in flat.T]
    return np.stack(columns, axis=-1).reshape(len(grid), *segment.p.shape[1:])


class Parts(NamedTuple):
    """Variances, m^2, summed over x, y, z and averaged over progress.

    Attributes:
      trocar: within a scene, over its trocars: 0 where Proposition 1 holds.
      common: the part of it that is the same in every scene: an offset of each trocar's own.
      scene: between the scenes' means over trocars.
    """

    trocar: float
    common: float
    scene: float

    @property
    def share(self) -> float:
        """Share of the variance that the trocar explains; 0 for a constant."""
        whole = self.trocar + self.scene
        return self.trocar / whole if whole > STILL**2 else 0.0


def parts(p: np.ndarray) -> Parts:
    """The variances of wanted positions `[S, C, G, 3]`.

    The trocars are all there are: their variance has the divisor C. Scenes are a sample: theirs has
    S - 1, and the chance part of a trocar's mean over scenes is subtracted from `common`.
    """
    scenes = len(p)
    of_scene = p.mean(1, keepdims=True)
    trocar = _square(p - of_scene)
    offset = _square((p - of_scene).mean(0))
    common = max(0.0, offset - (trocar - offset) / (scenes - 1))
    scene = _square(of_scene - of_scene.mean(0)) * scenes / (scenes - 1)
    return Parts(trocar, common, scene)


def together(found: Sequence[Parts], weights: Sequence[float]) -> Parts:
    """Variances averaged over phases or visits."""
    return Parts(*np.average(np.array(found), axis=0, weights=weights).tolist())


def interval(p: Sequence[np.ndarray], weights: Sequence[float]) -> list[float]:
    """95% of `share`, by drawing the scenes of every `[S, C, G, 3]` anew, the same ones where
    there are equally many. Drawn scenes repeat, which takes 1/S of their variance: put back.
    """
    shares = []
    for draw in range(RESAMPLES):
        picked = [np.random.default_rng(draw).integers(len(x), size=len(x)) for x in p]
        again = [parts(x[index]) for x, index in zip(p, picked, strict=True)]
        again = [a._replace(scene=a.scene * len(x) / (len(x) - 1)) for a, x in zip(again, p)]
        shares.append(together(again, weights).share)
    return np.quantile(shares, (0.025, 0.975)).tolist()


def _square(x: np.ndarray) -> float:
    return float(np.mean(np.sum(x**2, axis=-1)))
