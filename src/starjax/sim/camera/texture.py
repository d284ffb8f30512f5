"""Textures as the camera sees them: it and what wears them stand still, so they are drawn once."""

import numpy as np

from starjax.sim.camera import geometry as scenes
from starjax.sim.camera import tiles

_LOOKUPS = 6  # texel lookups along each side of a sample: smooths lines thinner than a pixel


def draw(scene: scenes.Scene, grid: tiles.Grid) -> dict[int, np.ndarray]:
    """RGB of each textured row through every sample, as if nothing stood before it: `[3, T, Q]`."""
    step_x = (scene.right - scene.left) / grid.width
    step_y = (scene.bottom - scene.top) / grid.height
    shifts = (np.arange(_LOOKUPS) + 0.5) / _LOOKUPS - 0.5
    return {
        row: np.mean(
            [
                _look(texture, grid.x + dx * step_x, grid.y + dy * step_y)
                for dx in shifts
                for dy in shifts
            ],
            axis=0,
        ).astype(np.float32)
        for row, texture in scene.textures.items()
    }


def _look(texture: scenes.Texture, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Texels where the rays through (x, y, -1) meet the plane of the texture, `[3, ...]`."""
    ray = np.stack([x, y, -np.ones_like(x)], -1) @ texture.R_cam_geom
    origin = -texture.p_cam_top @ texture.R_cam_geom
    t = -origin[2] / np.where(np.abs(ray[..., 2]) < 1e-9, 1e-9, ray[..., 2])
    h, w, _ = texture.texels.shape
    u, v = [(origin[k] + t * ray[..., k] - texture.corner[k]) * texture.scale[k] for k in range(2)]
    column = np.floor((u - np.floor(u)) * w).astype(int) % w
    line = np.floor((v - np.floor(v)) * h).astype(int) % h
    return np.moveaxis(texture.texels[line, column], -1, 0)
