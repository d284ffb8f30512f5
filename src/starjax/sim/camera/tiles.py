"""Tiles of an image, and a loop over the geoms that can be visible in each tile.

Every tile keeps its geoms as bits of 32-bit words. Each round of the loop takes the lowest bit of
every tile, until all words are 0: as many rounds as the fullest tile has geoms, without a list of
limited length. Bounds are conservative, so the image equals that of testing all geoms.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax.sim.camera import geometry as scenes

_SLACK = 1e-5  # m and relative: margin for float32 rounding

Array = jax.Array
Visit = Callable[..., Array]


class Grid(NamedTuple):
    """Rays through (x, y, -1) in T tiles of Q samples, V rows of U tiles.

    Attributes:
      side: samples along the side of a tile.
      x, y: `[T, Q]`.
      edges_x: `[U + 1]`, edges_y: `[V + 1]` sides of the tiles in the plane at depth 1.
      height, width: of the picture in samples, which the last tiles may overhang.
    """

    side: int
    x: np.ndarray
    y: np.ndarray
    edges_x: np.ndarray
    edges_y: np.ndarray
    height: int
    width: int


def grid(scene: scenes.RenderScene, height: int, width: int) -> Grid:
    """Makes the tiles of an image of `height` by `width` samples."""
    side = 8 if min(height, width) <= 128 else 16  # the faster one on two CPU cores
    rows, cols = -(-height // side), -(-width // side)
    step_x, step_y = (scene.right - scene.left) / width, (scene.bottom - scene.top) / height
    x = scene.left + (np.arange(cols * side) + 0.5) * step_x
    y = scene.top + (np.arange(rows * side) + 0.5) * step_y
    ones = np.ones((rows, cols, side, side))
    return Grid(
        side=side,
        x=(ones * x.reshape(1, cols, 1, side)).reshape(rows * cols, -1).astype(np.float32),
        y=(ones * y.reshape(rows, 1, side, 1)).reshape(rows * cols, -1).astype(np.float32),
        edges_x=(scene.left + np.arange(cols + 1) * side * step_x).astype(np.float32),
        edges_y=(scene.top + np.arange(rows + 1) * side * step_y).astype(np.float32),
        height=height,
        width=width,
    )


def picture(grid: Grid, tiled: Array) -> Array:
    """Joins tiles `[T, n * n]`, n a divisor of the side, to an image `[h, w]` without overhang."""
    rows, cols, n = len(grid.edges_y) - 1, len(grid.edges_x) - 1, math.isqrt(tiled.shape[1])
    whole = tiled.reshape(rows, cols, n, n).swapaxes(1, 2).reshape(rows * n, cols * n)
    return whole[: grid.height * n // grid.side, : grid.width * n // grid.side]


def pixels(grid: Grid, tiled: Array, samples: int) -> Array:
    """Splits the samples of every pixel: from `[T, Q]` to `[T, q, samples * samples]`."""
    n = grid.side // samples
    parts = tiled.reshape(-1, n, samples, n, samples).swapaxes(2, 3)
    return parts.reshape(-1, n * n, samples * samples)


def in_view(grid: Grid, c: Array, R: Array, axes: Array, rounding: Array) -> Array:
    """Returns `[T, N]` bool, True for geoms that can be visible in a tile.

    Args:
      c, R: `[N, 3]` m and `[N, 3, 3]` in the camera frame.
      axes, rounding: the rounded box that holds each geom, as in `RenderScene`; m.
    """
    rounding = rounding * (1 + _SLACK) + _SLACK
    depth_range = _reach(R[:, 2], axes) + rounding
    nearest = -c[:, 2] - depth_range

    def sides(edges: np.ndarray, axis: int) -> Array:
        """Returns `[U, N]` bool: between the planes through the camera and two adjacent edges."""
        e = edges[:, None]
        middle = c[:, axis] + e * c[:, 2]
        spread = _reach(R[:, axis] + e[..., None] * R[:, 2], axes) + rounding * jnp.hypot(1.0, e)
        above, below = middle + spread >= 0, middle - spread <= 0
        ascending = edges[1] > edges[0]
        low, high = (above, below) if ascending else (below, above)
        return low[:-1] & high[1:]

    # A long diagonal geom overlaps only tiles near the plane through the camera and its axis.
    u = _long_axis(R, axes)
    normal = jnp.cross(c, u)
    normal /= jnp.maximum(jnp.linalg.norm(normal, axis=-1, keepdims=True), _SLACK)
    spread = _reach(jnp.einsum("gi,gij->gj", normal, R, precision="highest"), axes) + rounding
    limit = jnp.where(nearest > _SLACK, spread / jnp.maximum(nearest, _SLACK), jnp.inf)
    across = normal[:, 0] * grid.edges_x[:, None], normal[:, 1] * grid.edges_y[:, None]
    (low_x, high_x), (low_y, high_y) = [
        (jnp.minimum(v[:-1], v[1:]), jnp.maximum(v[:-1], v[1:])) for v in across
    ]
    low = low_x[None] + low_y[:, None] - normal[:, 2]
    high = high_x[None] + high_y[:, None] - normal[:, 2]
    by_plane = (low <= limit) & (high >= -limit)

    in_front = c[:, 2] - depth_range < 0
    visible = sides(grid.edges_x, 0)[None] & sides(grid.edges_y, 1)[:, None] & by_plane & in_front
    return visible.reshape(-1, c.shape[0])


def over(low: Array, high: Array, c: Array, R: Array, axes: Array, rounding: Array) -> Array:
    """Returns `[T, N]` bool, True for geoms that can shade a tile's box of points (light frame).

    Args:
      low, high: `[T, 3]` corners of each tile's points in m; low > high for an empty tile.
      c, R, axes, rounding: as for `in_view`, but in the light frame (third axis to the light).
    """
    rounding = rounding * (1 + _SLACK) + _SLACK
    spread = jnp.stack([_reach(R[:, k], axes) for k in range(3)], -1) + rounding[:, None]
    middle, half = (low + high)[:, None] / 2, (high - low)[:, None] / 2
    offset = jnp.abs(c - middle) - half - spread
    near = jnp.all(offset[..., :2] <= 0, -1) & (c[:, 2] + spread[:, 2] >= low[:, 2:])
    u = _long_axis(R, axes)
    flat = jnp.hypot(u[:, 0], u[:, 1])[:, None]
    normal = jnp.stack([-u[:, 1], u[:, 0]], -1) / jnp.maximum(flat, _SLACK)
    reach = jnp.einsum("gi,gij->gj", normal, R[:, :2], precision="highest")
    # Both axes are written out: XLA for CPU (jaxlib 0.10) sums wrongly if a large array's last
    # axis of two is sliced, broadcast and summed; whole shadows were missing.
    i, j = normal[:, 0], normal[:, 1]
    extent = jnp.abs(i) * half[..., 0] + jnp.abs(j) * half[..., 1]
    limit = _reach(reach, axes) + rounding + extent
    aside = jnp.abs(i * (c[:, 0] - middle[..., 0]) + j * (c[:, 1] - middle[..., 1]))
    return near & (aside <= limit)


def each(overlap: Array, table: Array, visit: Visit, carry: Array, *pixels: Array) -> Array:
    """Folds `carry = visit(carry, row, features, *pixels)` over each tile's overlapping geoms.

    Args:
      overlap: `[T, N]` bool.
      table: `[N, F]`.
      visit: gets row `[T, 1]` (-1 for a finished tile) and F features `[T, 1]`.
      carry, pixels: `[T, Q]`; `visit` may get those of fewer tiles.
    """
    if not overlap.shape[1]:  # a scene without any of this kind
        return carry
    count = -(-overlap.shape[1] // 32)
    parts = jnp.pad(overlap, ((0, 0), (0, 32 * count - overlap.shape[1]))).reshape(-1, count, 32)
    words = jnp.sum(jnp.where(parts, _bit(jnp.arange(32)), 0), -1, dtype=jnp.uint32)
    return _rounds(words, table, visit, carry, pixels)


def _rounds(
    words: Array, table: Array, visit: Visit, carry: Array, pixels: tuple[Array, ...]
) -> Array:
    """Loops over all tiles while many are unfinished, then over the few that remain.

    Args:
      words: `[T, W]` uint32, a bit for every geom left.
    """
    few = len(words) // 6 if len(words) >= 64 else 0
    order = jnp.arange(words.shape[1])

    def busy(words):
        return jnp.any(words > 0, -1)

    def one(state):
        words, carry = state
        # w & -w keeps the lowest set bit; clz gives its index.
        lowest = 31 - jax.lax.clz(words & (~words + jnp.uint32(1))).astype(jnp.int32)
        row = jnp.min(jnp.where(words > 0, 32 * order + lowest, 32 * len(order)), -1)
        words ^= jnp.where(order == row[:, None] >> 5, _bit(row[:, None] & 31), 0)
        columns = table.T[:, jnp.minimum(row, len(table) - 1)]
        row = jnp.where(row < len(table), row, -1)
        return words, visit(carry, row[:, None], list(columns[:, :, None]), *pixels)

    words, carry = jax.lax.while_loop(lambda s: jnp.sum(busy(s[0])) > few, one, (words, carry))
    if few == 0:
        return carry
    first = jnp.argsort(~busy(words))[:few]
    mine = [v.at[first].get(mode="promise_in_bounds") for v in (words, carry, *pixels)]
    done = _rounds(mine[0], table, visit, mine[1], tuple(mine[2:]))
    return carry.at[first].set(done, mode="promise_in_bounds", unique_indices=True)


def _bit(index: Array) -> Array:
    return jnp.uint32(1) << index.astype(jnp.uint32)


def _reach(direction: Array, axes: Array) -> Array:
    """Returns half the extent `[..., N]` of a box along a direction in its own frame."""
    return jnp.sum(jnp.abs(direction) * axes, -1)


def _long_axis(R: Array, axes: Array) -> Array:
    """Returns the direction `[N, 3]` of each box's longest axis."""
    return jnp.take_along_axis(R, jnp.argmax(axes, -1)[:, None, None], axis=2)[..., 0]
