"""Images of a recorded episode at some of its control steps, drawn on demand at any size."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from starjax.data import redraw, store
from starjax.sim.rollouts import episodes


def of_episode(root: Path, key: str, steps: Sequence[int], size: int) -> dict[str, np.ndarray]:
    """Returns images `[len(steps), h, w, 3]` uint8 by camera.

    Recorded images keep their size. The result is empty if images can neither be read nor drawn.

    Args:
      root: folder of the dataset.
      key: of the episode.
      steps: control steps.
      size: pixels per side of drawn images.
    """
    description, record = store.read_description(root), store.verify(root, key)
    cameras = description["scene"]["cameras"]
    files = {camera: f"{episodes.IMAGE}{camera}.npy" for camera in cameras}
    recorded = {camera: file for camera, file in files.items() if file in record["files"]}
    if recorded:
        folder = root / "episodes" / key
        return {
            camera: np.load(folder / file, mmap_mode="r", allow_pickle=False)[list(steps)]
            for camera, file in recorded.items()
        }
    if not redraw.is_possible(description):
        return {}
    drawn = redraw.images(root, description, [record], redraw.scene_env(description, size))
    return {camera: images[np.asarray(steps)] for camera, images in drawn.items()}
