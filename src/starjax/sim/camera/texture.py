"""Textures in images: drawn once for a fixed camera, evaluated per image for a moving one."""

from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from starjax.core.types import Array
from starjax.sim.camera import geometry as scenes
from starjax.sim.camera import tiles

_LOOKUPS = 6  # texel lookups along each side of a sample, to smooth lines thinner than a pixel


def draw(scene: scenes.RenderScene, grid: tiles.Grid) -> dict[int, np.ndarray]:
    """Returns the RGB `[3, T, Q]` of each textured row through every sample, without occlusion."""
    step_x = (scene.right - scene.left) / grid.width
    step_y = (scene.bottom - scene.top) / grid.height
    shifts = (np.arange(_LOOKUPS) + 0.5) / _LOOKUPS - 0.5  # a grid within the pixel: antialiasing
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
    """Returns the texels `[3, ...]` at the rays through (x, y, -1) on the texture's plane."""
    ray = np.stack([x, y, -np.ones_like(x)], -1) @ texture.R_cam_geom
    origin = -texture.p_cam_top @ texture.R_cam_geom
    t = -origin[2] / np.where(np.abs(ray[..., 2]) < 1e-9, 1e-9, ray[..., 2])  # ray meets z = 0
    h, w, _ = texture.texels.shape
    u, v = [(origin[k] + t * ray[..., k] - texture.corner[k]) * texture.scale[k] for k in range(2)]
    column = np.floor((u - np.floor(u)) * w).astype(int) % w
    line = np.floor((v - np.floor(v)) * h).astype(int) % h
    return np.moveaxis(texture.texels[line, column], -1, 0)


def looker(
    texture: scenes.Texture, step: float, R_world_cam: Array, p_world_cam: Array
) -> Callable[[Sequence[Any]], list[Any]]:
    """Makes a function that evaluates a checker from any pose, filtered over each pixel.

    Args:
      texture: in the world's frame, a checker. Its first and last texel of a row are the colours.
      step: width of a pixel in the plane at depth 1.
      R_world_cam, p_world_cam: `[3, 3]` and `[3]` m, the camera's pose, traced.

    Returns:
      visible points x, y, z in the camera frame, `[T, Q]` m each -> red, green and blue.
    """
    first, second = texture.texels[0, 0], texture.texels[0, -1]
    R_geom_world = jnp.asarray(texture.R_cam_geom.T, jnp.float32)
    R_geom_cam = jnp.matmul(R_geom_world, R_world_cam, precision="highest")
    offset = p_world_cam - jnp.asarray(texture.p_cam_top, jnp.float32)
    origin = jnp.matmul(R_geom_world, offset, precision="highest")

    def look(p: Sequence[Any]) -> list[Any]:
        wave = 1.0
        for k in range(2):
            at = R_geom_cam[k, 0] * p[0] + R_geom_cam[k, 1] * p[1] + R_geom_cam[k, 2] * p[2]
            scale = float(texture.scale[k])
            u = (at + origin[k] - float(texture.corner[k])) * scale
            # Width of a pixel at the depth of the point, for a face perpendicular to the ray.
            wave = wave * _square_wave(u, -p[2] * step * abs(scale))
        middle, half = 0.5 * (first + second), 0.5 * (first - second)
        return [float(m) + float(h) * wave for m, h in zip(middle, half)]

    return look


def is_checker(texture: scenes.Texture) -> bool:
    """Returns True for two colours in four equal squares, as `looker` requires."""
    texels, (h, w) = texture.texels, np.array(texture.texels.shape[:2]) // 2
    same = np.all(texels[:h, :w] == texels[0, 0]) and np.all(texels[h:, w:] == texels[0, 0])
    return bool(
        same and np.all(texels[:h, w:] == texels[0, -1]) and np.all(texels[h:, :w] == texels[0, -1])
    )


def _square_wave(u: Array, width: Array) -> Any:
    """Averages, over `width`, the wave of 1 on the first half of each unit and -1 on the other."""

    def integral(x: Array) -> Any:
        fraction = x - jnp.floor(x)
        return jnp.where(fraction < 0.5, fraction, 1.0 - fraction)

    width = jnp.maximum(width, 1e-6)
    mean = (integral(u + 0.5 * width) - integral(u - 0.5 * width)) / width
    return jnp.clip(mean, -1.0, 1.0)
