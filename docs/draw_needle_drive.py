"""Draws images/needle_drive.png and needle_drive.mp4: needle drive through its two cameras.

python docs/draw_needle_drive.py OTHER.safetensors

The packaged policy, and one that was trained with the usual camera (experiments/needle_drive has
the command), in the same trial, in which the second one misses the exit mark.
"""

import pathlib
import sys

import numpy as np
from PIL import Image

from starjax import runtime
from starjax.policies import packaged
from starjax.report import encode, scene_view, video
from starjax.sim.tasks.base import CONTROL_HZ
from starjax.viewer import frame as frames
from starjax.viewer import simulation

IMAGES = pathlib.Path(__file__).parent / "images"
SIZE = 256  # pixels, side of a picture
TRIAL = (0, 9, 0)  # seed, trocar and number: an unseen trocar
LONGEST = 300  # control steps
MOMENTS = (0.0, 0.35, 0.5, 0.7, 1.0)  # fractions of a trial


def main(other: str) -> None:
    """Writes the film and a strip of its pictures."""
    runtime.prepare_xla()
    files = {
        "near camera": packaged.locate("needle_drive"),
        "usual camera": pathlib.Path(other),
    }
    films = {label: pictures(file) for label, file in files.items()}
    count = max(map(len, films.values()))
    held = [[*film, *[film[-1]] * (count - len(film))] for film in films.values()]
    bars = [video.caption([[(label, "#e6e9ec")]], SIZE) for label in films]
    sides = ([np.concatenate([bar, now]) for bar, now in zip(bars, both)] for both in zip(*held))
    encode.write(
        (np.concatenate(both, 1) for both in sides), IMAGES / "needle_drive.mp4", CONTROL_HZ
    )
    strips = [
        np.concatenate([film[round(share * (len(film) - 1))] for share in MOMENTS], 1)
        for film in films.values()
    ]
    Image.fromarray(np.concatenate(strips)).save(IMAGES / "needle_drive.png", optimize=True)


def pictures(file: pathlib.Path) -> list[np.ndarray]:
    """Runs a trial; returns its pictures `[SIZE, SIZE, 3]` by the usual camera."""
    run = simulation.load(simulation.from_file(file))
    live, now = run.start(*TRIAL, None)
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
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(sys.argv[1])
