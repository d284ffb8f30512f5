"""Draws images/suture_throw_policy.png and suture_throw.mp4: trials of a policy, side by side.

python docs/draw_suture_throw.py EVALUATION TROCAR:TRIAL TROCAR:TRIAL

EVALUATION is the folder of an evaluation that recorded these trials (`--eval.video-trials`).
"""

import itertools
import pathlib
import sys

import numpy as np
from PIL import Image

from starjax import runtime
from starjax.report import encode, outcomes, results, scene_view, video

IMAGES = pathlib.Path(__file__).parent / "images"
SIZE = 256  # pixels, side of a picture
SPEED = 4  # times real time
MOMENTS = (0.07, 0.3, 0.5, 0.7, 0.85, 1.0)  # fractions of a trial


def main(folder: str, *trials: str) -> None:
    """Writes the film and a strip of its pictures."""
    runtime.prepare_xla()
    run = results.load(pathlib.Path(folder))
    recorded = {f"{one.trial.trocar}:{one.trial.trial}": one for one in run.rollouts}
    films = [pictures(video.Clip(run.label, run.result, recorded[name])) for name in trials]
    last: list[np.ndarray] = []

    def sides():
        nonlocal last
        for now in itertools.zip_longest(*films):
            last = [old if new is None else new for new, old in zip(now, last or now)]
            yield np.concatenate(last, 1)

    encode.write(sides(), IMAGES / "suture_throw.mp4", run.result.control_hz)
    strips = [
        np.concatenate([film[round(share * (len(film) - 1))] for share in MOMENTS], 1)
        for film in films
    ]
    Image.fromarray(np.concatenate(strips)).save(IMAGES / "suture_throw_policy.png", optimize=True)


def pictures(clip: video.Clip) -> list[np.ndarray]:
    """Draws every SPEED-th step of a recorded trial, `[SIZE + bar, SIZE, 3]`, and its outcome."""
    rollout, hz, still = clip.rollout, clip.result.control_hz, clip.still
    draw = scene_view.camera(clip.result.scene, SIZE)
    won = outcomes.strict(rollout.trial)
    end = "success" if won else outcomes.SHORT[outcomes.failure(rollout.trial)]
    steps = np.append(np.arange(0, len(rollout.qpos) - 1, SPEED), len(rollout.qpos) - 1)
    qpos, found = rollout.qpos[steps], []
    for first in range(0, len(steps), scene_view.BATCH):
        drawn = draw(qpos, rollout.p_world_trocar, {}, first, still=still)
        for step, image in zip(steps[first:], drawn):
            time = f"{step / hz:.0f} s"
            text = f"{end}, {time}" if step == steps[-1] else time
            found.append(np.concatenate([video.caption([[(text, "#e6e9ec")]], SIZE), image]))
    return found


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    main(*sys.argv[1:])
