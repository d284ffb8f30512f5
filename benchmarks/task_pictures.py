"""Draws each task as its camera sees it, while its expert is at work in C MuJoCo.

python benchmarks/task_pictures.py FIGURE.png [TITLE ...]
"""

import sys
from pathlib import Path
from typing import Any

import _c_env
import jax
import jax.numpy as jnp
import numpy as np

from starjax import runtime
from starjax.report import style
from starjax.sim import env as envs
from starjax.sim import registries

PIXELS = 384  # a side of a picture
COLUMNS = 4
# Title, which begins with the task; control steps of an episode after which there is something to
# see, and by which camera.
MOMENTS = {
    "reach": (25, "camera"),
    "peg_transfer": (110, "camera"),
    "needle_pick": (115, "camera"),
    "ring_on_wire": (150, "camera"),
    "peg_transfer_bimanual": (170, "side"),
    "needle_handover": (235, "side"),
    "endoscope_track": (120, "camera"),
    "endoscope_track: its image": (120, "endoscope"),
    "needle_regrasp": (120, "camera"),
    "needle_drive": (160, "camera"),
    "needle_drive: its near camera": (160, "camera_near"),
    "suture_throw": (420, "camera"),
}
TROCAR = 1  # index of the task's twelve


def main(file: Path, *titles: str) -> None:
    runtime.prepare_xla()
    pictures = {
        title: picture(title.partition(":")[0], *MOMENTS[title]) for title in titles or MOMENTS
    }
    file.write_bytes(style.save(draw(pictures), "png"))


def picture(task: str, steps: int, camera: str) -> np.ndarray:
    """`[PIXELS, PIXELS, 3]` uint8, after `steps` of the task's first expert."""
    environment = envs.make(task, image_size=PIXELS, cameras=[camera])
    environment = _c_env.with_c_physics(environment)
    expert = registries.tasks.get(task).expert()
    trocar = jax.tree.map(lambda leaf: jnp.asarray(leaf)[TROCAR], environment.task.trocars)

    @jax.jit
    def play(key: jax.Array) -> jax.Array:
        start, choices = jax.random.split(key)
        state = environment.reset(start, envs.EnvParams(trocar))

        def step(_, carry):
            state, memory = carry
            command, memory, _ = expert.act(memory, state)
            return environment.step(state, command), memory

        carry = (state, expert.init(choices, state))
        state, _ = jax.lax.fori_loop(0, steps, step, carry)
        return environment.camera(state)[camera].rgb

    return np.asarray(play(jax.random.key(0)))


def draw(pictures: dict[str, np.ndarray]) -> Any:
    """The pictures side by side, with their titles."""
    rows = -(-len(pictures) // COLUMNS)
    with style.use():
        figure = style.figure(2.4 * COLUMNS, 2.65 * rows)
        axes = figure.subplots(rows, COLUMNS, squeeze=False).ravel()
        for axis in axes:
            axis.set_axis_off()
        for axis, (title, rgb) in zip(axes, pictures.items(), strict=False):
            axis.imshow(rgb)
            axis.set_title(title)
        return figure


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
