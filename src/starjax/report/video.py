"""The rollout video: recorded joint positions drawn again by the simulator's own camera."""

import functools
import itertools
import pathlib
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from starjax.evaluation.result import Result
from starjax.report import compare, encode, outcomes, results, scene_view, style
from starjax.sim.names import SceneNames

SIZE = 384  # pixels a side of one rollout's images
_BAR = 44  # pixels of the caption over it
_HOLD = 1.5  # s that the last image stays
_LONGEST = 12.0  # s shown of a rollout
_GAP = 4  # pixels between images
_MUTED = "#98a2ad"


def record(
    runs: Sequence[results.Run],
    path: pathlib.Path,
    report: Callable[[str], None] = print,
) -> pathlib.Path | None:
    """Draws a few recorded rollouts into the file `path`; returns None if there are none.

    Args:
      runs: of whose representatives `choose` picks.
      path: of the mp4.
      report: gets a line for the user.

    Raises:
      OSError, RuntimeError: the encoder failed, or there is none for this machine.
    """
    chosen = choose(compare.representatives(runs))
    if not chosen:
        return None
    report(f"drawing {len(chosen)} rollouts for the video")
    cameras = functools.cache(lambda names: scene_view.camera(names, SIZE))
    note = f"sees the {compare.observed(runs)}"
    encode.write(frames(chosen, cameras, note), path, chosen[0].result.control_hz)
    return path


class Clip(NamedTuple):
    """A rollout in the video: the method's name, the result that it is of, and itself."""

    label: str
    result: Result
    rollout: results.TrialTrajectory


def choose(runs: Sequence[results.Run], most: int = 4) -> list[Clip]:
    """Rollouts to show side by side, `most` at most.

    One run: half of them at seen and half at unseen trocars, spread over these, an even number if
    there are two or more. Several runs: one trial that as many of them as possible recorded, at an
    unseen trocar if there is one. The choice does not look at how a rollout ended.
    """
    if len(runs) > 1:
        return _same_trial(runs, most)
    pool = [r for run in runs for r in run.rollouts if r.qpos is not None]
    seen, unseen = ([r for r in pool if r.trial.seen is part] for part in (True, False))
    new = _spread(unseen, most - len(_spread(seen, most // 2)))
    chosen = [*_spread(seen, most - len(new)), *new]
    even = len(chosen) if len(chosen) < 2 else len(chosen) // 2 * 2
    return [Clip(runs[0].label, runs[0].result, r) for r in chosen[:even]]


def frames(
    chosen: Sequence[Clip], cameras: Callable[[SceneNames], scene_view.Draw], note: str = ""
) -> Iterator[np.ndarray]:
    """Images `[h, w, 3]` uint8 of the chosen rollouts side by side in real time, captions over.

    Drawn while they are asked for: a whole video would not fit the memory of a small machine.

    Args:
      chosen: from `choose`.
      cameras: gives `scene_view.camera`'s function of a scene.
      note: said in every caption, such as what the policy observes.
    """
    clips = [_clip(cameras(shown.result.scene), shown, note) for shown in chosen]
    last: list[np.ndarray] = []
    for now in itertools.zip_longest(*clips):
        # A clip that ends early stays as it ended.
        last = [old if new is None else new for new, old in zip(now, last or now)]
        yield _grid(last)
    for _ in range(round(_HOLD * chosen[0].result.control_hz)):
        yield _grid(last)


def caption(rows: Sequence[Sequence[tuple[str, str]]], width: int) -> np.ndarray:
    """`[_BAR, width, 3]` uint8: a dark bar with rows of two (text, colour), left and right."""
    from PIL import Image, ImageDraw, ImageFont

    line = _BAR / len(rows)
    data = style.library().get_data_path()
    font = ImageFont.truetype(f"{data}/fonts/ttf/DejaVuSans.ttf", round(0.58 * line))
    image = Image.new("RGB", (width, _BAR), "#14181c")
    pen = ImageDraw.Draw(image)
    for i, row in enumerate(rows):
        for (text, color), (x, anchor) in zip(row, ((10, "lm"), (width - 10, "rm"))):
            pen.text((x, line * (i + 0.55)), text, fill=color, font=font, anchor=anchor)
    return np.asarray(image)


def _clip(draw: scene_view.Draw, shown: Clip, note: str) -> Iterator[np.ndarray]:
    """Images of one rollout under a bar: what is shown, the clock, and at the end the outcome."""
    rollout, hz = shown.rollout, shown.result.control_hz
    if rollout.qpos is None:
        raise ValueError("shown: expected a rollout with joint positions, got none")
    kind, total = "seen" if rollout.trial.seen else "unseen", len(rollout.p_world_tip)
    steps = min(total, round(_LONGEST * hz))
    won = outcomes.strict(rollout.trial)
    end = "success" if won else outcomes.SHORT[outcomes.failure(rollout.trial)]
    outcome = (f"{end}, {total / hz:.1f} s", "#5ab4e8" if won else "#f09a5a")
    cut = "" if steps == total else f"first {steps / hz:.0f} s shown"
    told = f"{kind} trocar {rollout.trial.trocar}" + (f", {note}" if note else "")
    about = (told, _MUTED), (cut, _MUTED)
    for first in range(0, steps, scene_view.BATCH):
        drawn = draw(rollout.qpos, rollout.p_world_trocar, rollout.labels, first, rollout.endoscope)
        for step, image in enumerate(drawn[: steps - first], start=first):
            now = outcome if step == steps - 1 else (f"{step / hz:.0f} s", _MUTED)
            bar = caption([[(shown.label, "#e6e9ec"), now], about], image.shape[1])
            yield np.concatenate([bar, image])


def _grid(tiles: Sequence[np.ndarray]) -> np.ndarray:
    """Tiles `[h, w, 3]` in rows of two, three in one row, `_GAP` dark pixels between them."""
    h, w = tiles[0].shape[:2]
    columns = len(tiles) if len(tiles) <= 3 else 2
    rows = -(-len(tiles) // columns)
    grid = np.full(((h + _GAP) * rows - _GAP, (w + _GAP) * columns - _GAP, 3), 20, np.uint8)
    for i, tile in enumerate(tiles):
        y, x = (h + _GAP) * (i // columns), (w + _GAP) * (i % columns)
        grid[y : y + h, x : x + w] = tile
    return grid


def _spread(rollouts: list[results.TrialTrajectory], most: int) -> list[results.TrialTrajectory]:
    """Up to `most` of them, spread evenly; each trocar's first trial before any second one."""
    ordered = sorted(rollouts, key=lambda r: (r.trial.trial, r.trial.trocar))
    first = [r for r in ordered if r.trial.trial == ordered[0].trial.trial]
    pool = first if len(first) >= most else ordered
    picks = np.linspace(0, len(pool) - 1, min(most, len(pool))).round().astype(int)
    return [pool[i] for i in picks]


def _same_trial(runs: Sequence[results.Run], most: int) -> list[Clip]:
    """The same trial of up to `most` runs; the last ones where there are more."""
    kept = [
        {compare.identity(r.trial): r for r in run.rollouts if r.qpos is not None} for run in runs
    ]
    found = [(run, rollouts) for run, rollouts in zip(runs, kept) if rollouts][-most:]
    if not found:
        return []
    pick = compare.most_shared(r.trial for _, rollouts in found for r in rollouts.values())
    return [
        Clip(run.label, run.result, rollouts[pick]) for run, rollouts in found if pick in rollouts
    ]
