"""Draws images/FIGURE.png and .mp4: trials of policies as the task's usual camera sees them.

python docs/draw_trials.py needle_drive "near camera:9/0=needle_drive" \\
    "usual camera:9/0=USUAL.safetensors"
python docs/draw_trials.py needle_regrasp "STAR-Diff-Pose:9/3=POSE.safetensors" \\
    "same, other trial:9/22=POSE.safetensors" "STAR-Diff-Wrist:9/3=WRIST.safetensors"

A row is LABEL:TROCAR/TRIAL=POLICY, of a packaged policy or a file; the trials are those of an
evaluation with seed 0. `experiments/` has the commands that trained the policies.
"""

import pathlib
import sys

import numpy as np
from PIL import Image

from starjax import runtime
from starjax.addons.viewer import frame as frames
from starjax.addons.viewer import simulation
from starjax.policies import packaged
from starjax.report import encode, scene_view, video
from starjax.sim.task import CONTROL_HZ

IMAGES = pathlib.Path(__file__).parent / "images"
SIZE = 256  # pixels, side of a picture
SEED = 0
LONGEST = 300  # control steps
MOMENTS = (0.0, 0.35, 0.5, 0.7, 1.0)  # fractions of a trial


def main(figure: str, rows: list[str]) -> None:
    """Writes the film and a strip of its pictures."""
    runtime.prepare_xla()
    films = dict(film(row) for row in rows)
    count = max(map(len, films.values()))
    held = [[*film, *[film[-1]] * (count - len(film))] for film in films.values()]
    bars = [video.caption([[(label, "#e6e9ec")]], SIZE) for label in films]
    sides = ([np.concatenate([bar, now]) for bar, now in zip(bars, both)] for both in zip(*held))
    encode.write((np.concatenate(both, 1) for both in sides), IMAGES / f"{figure}.mp4", CONTROL_HZ)
    strips = [
        np.concatenate([film[round(share * (len(film) - 1))] for share in MOMENTS], 1)
        for film in films.values()
    ]
    Image.fromarray(np.concatenate(strips)).save(IMAGES / f"{figure}.png", optimize=True)


def film(row: str) -> tuple[str, list[np.ndarray]]:
    """Returns a row's label and the pictures of its trial."""
    label, _, rest = row.rpartition(":")
    trial, _, name = rest.partition("=")
    trocar, number = map(int, trial.split("/"))
    file = pathlib.Path(name) if name.endswith(".safetensors") else packaged.locate(name)
    return label, pictures(file, (SEED, trocar, number))


def pictures(file: pathlib.Path, trial: tuple[int, int, int]) -> list[np.ndarray]:
    """Runs a trial; returns its pictures `[SIZE, SIZE, 3]` by the usual camera."""
    run = simulation.load(simulation.from_file(file))
    live, now = run.start(*trial, None)
    seen = [now]
    while not frames.outcome(now) and len(seen) < LONGEST:
        live, now = run.step(live, now.p_world_trocar)
        seen.append(now)
    print(file.name, frames.outcome(now) or "no success", f"{len(seen) / CONTROL_HZ:.1f} s")
    draw = scene_view.camera(run.env.names._replace(cameras=("camera",)), SIZE)
    qpos = np.stack([one.qpos for one in seen])
    batches = [
        draw(qpos, now.p_world_trocar, {}, first, still=now.still)
        for first in range(0, len(qpos), scene_view.BATCH)
    ]
    return list(np.concatenate(batches)[: len(qpos)])


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    main(sys.argv[1], sys.argv[2:])
