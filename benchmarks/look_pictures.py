"""Draws peg transfer's and needle pick's objects with the plain look and with that of tissue.

python benchmarks/look_pictures.py FIGURE.png
"""

import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from starjax import runtime
from starjax.core.types import Pose
from starjax.report import style
from starjax.sim import endoscope_camera, render, scene
from starjax.sim.camera import tissue

PIXELS = 240  # a side of an image
VIEWS = {"peg_transfer": "camera", "needle_pick": endoscope_camera.NAME}


def main(file: Path) -> None:
    """Writes the figure: tasks and looks side by side."""
    runtime.prepare_xla()
    rows = [
        np.concatenate([picture(task, camera, look) for look in ("", tissue.NAME)], axis=1)
        for task, camera in VIEWS.items()
    ]
    file.write_bytes(style.save(draw(np.concatenate(rows, axis=1)), "png"))


def picture(task: str, camera: str, look: str) -> np.ndarray:
    """Returns the image `[PIXELS, PIXELS, 3]` of the model as in its MJCF."""
    model = scene.compose(scene.name(task, cameras=[camera]))
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    shoot = render.make(model, camera, PIXELS, PIXELS, samples=2, moves=True, look=look)
    here = model.camera(camera).id
    pose = Pose(data.cam_xmat[here].reshape(3, 3), data.cam_xpos[here])
    places = data.geom_xpos, data.geom_xmat.reshape(-1, 3, 3), render.geom_rgb(model)
    inputs = jax.tree.map(jnp.float32, (*places, pose))
    return np.asarray(jax.jit(shoot)(*inputs).rgb)


def draw(image: np.ndarray) -> Any:
    """Returns a figure with the image alone."""
    with style.use():
        figure = style.figure(9.6, 9.6 * image.shape[0] / image.shape[1])
        axes = figure.subplots()
        axes.set_axis_off()
        axes.imshow(image)
        return figure


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
