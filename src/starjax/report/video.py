"""The rollout video: recorded joint positions, rendered by the simulator's camera."""

import functools
import itertools
import pathlib
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from starjax.core.types import Pose
from starjax.evaluation import paired
from starjax.evaluation.result import Result
from starjax.report import compare, encode, outcomes, results, scene_view, style
from starjax.sim.names import SceneNames
from starjax.sim.rollouts import trial_key

SIZE = 384  # pixels, side of one rollout's images
_BAR = 44  # pixels, height of the caption
_HOLD = 1.5  # s, time that the last image stays
_LONGEST = 12.0  # s, longest duration shown of a rollout
_GAP = 4  # pixels between images
_MUTED = "#98a2ad"


def record(
    runs: Sequence[results.Run],
    path: pathlib.Path,
    report: Callable[[str], None] = print,
) -> pathlib.Path | None:
    """Writes a video of a few recorded rollouts; returns None without any.

    Args:
      runs: runs whose representatives are shown.
      path: the mp4 file.
      report: receives a line for the user.

    Raises:
      OSError, RuntimeError: the encoder failed or is not installed.
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
    """A rollout in the video.

    Attributes:
      label: the method's name.
      result: its result.
      rollout: its trajectory.
    """

    label: str
    result: Result
    rollout: results.TrialTrajectory

    @property
    def still(self) -> Pose | None:
        """Poses `[K]` of the task's bodies at rest, or None."""
        trial = self.rollout.trial
        scene, seed = self.result.scene, self.result.seed
        return trial_key.bodies_at_rest(scene, seed, trial.trocar, trial.trial)


def choose(runs: Sequence[results.Run], max_clips: int = 4) -> list[Clip]:
    """Selects rollouts to show side by side, regardless of their outcome.

    From one run: half at seen and half at unseen trocars, spread over these; an even number if
    there are two or more. From several runs: one trial that most of them recorded, preferably at
    an unseen trocar.
    """
    if len(runs) > 1:
        return _same_trial(runs, max_clips)
    pool = [r for run in runs for r in run.rollouts if r.qpos is not None]
    seen, unseen = ([r for r in pool if r.trial.seen is part] for part in (True, False))
    new = _spread(unseen, max_clips - len(_spread(seen, max_clips // 2)))
    chosen = [*_spread(seen, max_clips - len(new)), *new]
    even = len(chosen) if len(chosen) < 2 else len(chosen) // 2 * 2
    return [Clip(runs[0].label, runs[0].result, r) for r in chosen[:even]]


def frames(
    chosen: Sequence[Clip], cameras: Callable[[SceneNames], scene_view.Draw], note: str = ""
) -> Iterator[np.ndarray]:
    """Yields images `[h, w, 3]` uint8 of rollouts side by side in real time, with captions.

    They are drawn lazily: a whole video would not fit the memory of a small machine.

    Args:
      chosen: from `choose`.
      cameras: a scene's names -> its `scene_view.camera`.
      note: text of every caption, such as the policy's observation.
    """
    clips = [_clip(cameras(clip.result.scene), clip, note) for clip in chosen]
    last: list[np.ndarray] = []
    for now in itertools.zip_longest(*clips):
        # A clip that ends early stays as it ended.
        last = [old if new is None else new for new, old in zip(now, last or now)]
        yield _grid(last)
    for _ in range(round(_HOLD * chosen[0].result.control_hz)):
        yield _grid(last)


def caption(rows: Sequence[Sequence[tuple[str, str]]], width: int) -> np.ndarray:
    """Draws a dark bar `[_BAR, width, 3]` uint8 with rows of (text, colour), left and right."""
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


def _clip(draw: scene_view.Draw, clip: Clip, note: str) -> Iterator[np.ndarray]:
    """Yields images of one rollout under a bar with its name, the time and the outcome."""
    rollout, hz = clip.rollout, clip.result.control_hz
    if rollout.qpos is None:
        raise ValueError("clip: expected a rollout with joint positions, got none")
    kind, total = "seen" if rollout.trial.seen else "unseen", len(rollout.p_world_tip)
    steps = min(total, round(_LONGEST * hz))
    won = outcomes.strict(rollout.trial)
    end = "success" if won else outcomes.SHORT[outcomes.failure(rollout.trial)]
    outcome = (f"{end}, {total / hz:.1f} s", "#5ab4e8" if won else "#f09a5a")
    cut = "" if steps == total else f"first {steps / hz:.0f} s shown"
    text = f"{kind} trocar {rollout.trial.trocar}" + (f", {note}" if note else "")
    about = (text, _MUTED), (cut, _MUTED)
    still = clip.still
    for first in range(0, steps, scene_view.BATCH):
        drawn = draw(
            rollout.qpos, rollout.p_world_trocar, rollout.labels, first, rollout.endoscope, still
        )
        for step, image in enumerate(drawn[: steps - first], start=first):
            now = outcome if step == steps - 1 else (f"{step / hz:.0f} s", _MUTED)
            bar = caption([[(clip.label, "#e6e9ec"), now], about], image.shape[1])
            yield np.concatenate([bar, image])


def _grid(tiles: Sequence[np.ndarray]) -> np.ndarray:
    """Arranges tiles `[h, w, 3]` in rows of two, or three in one row."""
    h, w = tiles[0].shape[:2]
    columns = len(tiles) if len(tiles) <= 3 else 2
    rows = -(-len(tiles) // columns)
    grid = np.full(((h + _GAP) * rows - _GAP, (w + _GAP) * columns - _GAP, 3), 20, np.uint8)
    for i, tile in enumerate(tiles):
        y, x = (h + _GAP) * (i // columns), (w + _GAP) * (i % columns)
        grid[y : y + h, x : x + w] = tile
    return grid


def _spread(rollouts: list[results.TrialTrajectory], count: int) -> list[results.TrialTrajectory]:
    """Selects up to `count`, spread evenly; first trials of all trocars before second ones."""
    ordered = sorted(rollouts, key=lambda r: (r.trial.trial, r.trial.trocar))
    first = [r for r in ordered if r.trial.trial == ordered[0].trial.trial]
    pool = first if len(first) >= count else ordered
    picks = np.linspace(0, len(pool) - 1, min(count, len(pool))).round().astype(int)
    return [pool[i] for i in picks]


def _same_trial(runs: Sequence[results.Run], max_clips: int) -> list[Clip]:
    """Selects the same trial of up to `max_clips` runs, the last ones of more."""
    kept = [
        {paired.identity(r.trial): r for r in run.rollouts if r.qpos is not None} for run in runs
    ]
    recorded = [(run, rollouts) for run, rollouts in zip(runs, kept) if rollouts][-max_clips:]
    if not recorded:
        return []
    pick = compare.most_shared(r.trial for _, rollouts in recorded for r in rollouts.values())
    having = [(run, rollouts[pick]) for run, rollouts in recorded if pick in rollouts]
    return [Clip(run.label, run.result, rollout) for run, rollout in having]
