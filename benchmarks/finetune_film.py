"""Draws a trial that fails before a fine-tuning and succeeds after it, as a strip and as a film.

python benchmarks/finetune_film.py RUN FIGURE.png [FILM.mp4] [--trial TROCAR TRIAL]

RUN is the directory of a `starjax finetune` with `--eval.video-trials`.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from starjax import runtime
from starjax.report import encode, outcomes, results, scene_view, style, video

PIXELS = 256  # a side of a picture
PICTURES = 6  # moments of each trial
FIRST = 0.2  # fraction of a trial's duration: before, the tools approach


def main() -> None:
    """Writes the figure, and the film if it is named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("figure", type=Path)
    parser.add_argument("film", type=Path, nargs="?")
    parser.add_argument("--trial", type=int, nargs=2, metavar=("TROCAR", "TRIAL"))
    args = parser.parse_args()
    runtime.prepare_xla()
    before, after = (results.load(args.run / name) for name in ("before", "after"))
    clips = choose(before, after, args.trial)
    with style.use():
        args.figure.write_bytes(style.save(draw(clips), "png"))
    if args.film:
        cameras = lambda names: scene_view.camera(names, video.SIZE)  # noqa: E731
        encode.write(video.frames(clips, cameras), args.film, clips[0].result.control_hz)


def choose(before: results.Run, after: results.Run, named: list[int] | None) -> list[video.Clip]:
    """Returns the trial before and after; by default the shortest failure at an unseen trocar."""
    later = {(r.trial.trocar, r.trial.trial): r for r in after.rollouts}
    pairs = [
        (r, later[r.trial.trocar, r.trial.trial])
        for r in before.rollouts
        if (r.trial.trocar, r.trial.trial) in later and not outcomes.strict(r.trial)
    ]
    mended = [pair for pair in pairs if outcomes.strict(pair[1].trial)]
    mended.sort(key=lambda pair: (pair[0].trial.seen, len(pair[0].p_world_tip)))
    for old, new in mended:
        place = old.trial.trocar, old.trial.trial
        print(place, outcomes.failure(old.trial), len(old.p_world_tip), len(new.p_world_tip))
    if named:
        mended = [pair for pair in mended if [pair[0].trial.trocar, pair[0].trial.trial] == named]
    if not mended:
        raise SystemExit(f"{before.path.parent}: no recorded trial fails before and succeeds after")
    old, new = mended[0]
    named_clips = ("before", before.result, old), ("after fine-tuning", after.result, new)
    return [video.Clip(*clip) for clip in named_clips]


def draw(clips: list[video.Clip]) -> Any:
    """Draws moments of both trials in a row per trial, the last one at the end."""
    camera = scene_view.camera(clips[0].result.scene, PIXELS)
    figure = style.figure(1.5 * PICTURES, 3.3)
    for axes, clip in zip(figure.subplots(len(clips), PICTURES), clips, strict=True):
        rollout, hz = clip.rollout, clip.result.control_hz
        last = len(rollout.p_world_tip) - 1
        won = outcomes.strict(rollout.trial)
        end = "success" if won else outcomes.SHORT[outcomes.failure(rollout.trial)]
        steps = np.linspace(FIRST * last, last, PICTURES).round().astype(int)
        for axis, step in zip(axes, steps.tolist(), strict=True):
            image = camera(rollout.qpos, rollout.p_world_trocar, rollout.labels, step)[0]
            axis.set_axis_off()
            axis.imshow(image)
            what = f", {end}" if step == last else ""
            axis.set_title(f"{(step + 1) / hz:.1f} s{what}", fontsize=7)
        axes[0].set_title(f"{clip.label}, {(steps[0] + 1) / hz:.1f} s", fontsize=7)
    return figure


if __name__ == "__main__":
    main()
