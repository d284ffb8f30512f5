"""One picture: the nearest geom along every ray, the sun's shadow, the colour."""

import jax
import jax.numpy as jnp
import numpy as np

from starjax.sim.camera import scene as scenes
from starjax.sim.camera import shade, shapes, tiles

Array = jax.Array


def cast(
    scene: scenes.Scene, grid: tiles.Grid, shadow: bool, geom_xpos: Array, geom_xmat: Array,
    geom_rgb: Array,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Depth `[T, Q]` m, slot `[T, Q]` (-1 background) and colour `[T, Q, 3]`, tile by tile."""
    R_cam_world = jnp.asarray(scene.R_world_cam.T, jnp.float32)
    offset = geom_xpos[scene.ids] - jnp.asarray(scene.p_world_cam, jnp.float32)
    c = jnp.einsum("ij,gj->gi", R_cam_world, offset, precision="highest")
    R = jnp.einsum("ij,gjk->gik", R_cam_world, geom_xmat[scene.ids], precision="highest")
    t, slot = _nearest(scene, grid, c, R)
    seen = slot >= 0
    depth = jnp.where(seen, t, 1.0)
    p = [grid.x * depth, grid.y * depth, -depth]
    shaded = jnp.zeros_like(seen)
    if shadow and scene.sun is not None:
        shaded = _shaded(scene, scene.sun, c, R, p, slot)
    footprint = (scene.right - scene.left) / grid.width
    rgb = shade.light(scene, geom_rgb[scene.ids], c, R, p, slot, shaded, footprint)
    return t, slot, rgb


def _nearest(scene, grid, c: Array, R: Array) -> tuple[Array, Array]:
    """Depth in m and slot of what each ray meets first.

    Depth and slot travel in one int32: positive floats order like their bits, and the last few
    bits of the mantissa (2^-17 of the depth with 63 geoms) make room for the slot.
    """
    room = (1 << len(scene.ids).bit_length()) - 1
    finite = c, R, jnp.asarray(scene.axes, jnp.float32), jnp.asarray(scene.rounding, jnp.float32)
    size = jnp.asarray(scene.size, jnp.float32)
    seen = tiles.in_view(grid, *finite)

    def pack(t, slot):
        return (jax.lax.bitcast_convert_type(t, jnp.int32) & ~room) | slot

    x, y = jnp.asarray(grid.x), jnp.asarray(grid.y)
    key = pack(jnp.full_like(x, shapes.FAR), room)
    for kind in (scenes.CAPSULE, scenes.CYLINDER, scenes.BOX, scenes.PLANE):
        of = scene.slots(kind)
        if not of:
            continue
        mine = slice(of.start, of.stop)

        def meet(key, slot, features, kind=kind):
            t = shapes.view(kind, x, y, features)
            return jnp.minimum(key, jnp.where(slot >= 0, pack(t, slot), key))

        table = shapes.features(kind, c[mine], R[mine], size[mine])
        key = tiles.each(seen[:, mine], table, of.start, meet, key)
    t = jax.lax.bitcast_convert_type(key & ~room, jnp.float32)
    return t, jnp.where(t < shapes.FAR, key & room, -1)


def _shaded(scene, sun, c: Array, R: Array, p: list[Array], slot: Array) -> Array:
    """Which visible points another geom hides from the sun. Shapes are convex: none hides itself."""
    R_light_cam = _frame(-sun.direction)
    to_light = jnp.asarray(R_light_cam)
    c = jnp.einsum("ij,gj->gi", to_light, c, precision="highest")
    R = jnp.einsum("ij,gjk->gik", to_light, R, precision="highest")
    q = [sum(float(R_light_cam[i, k]) * p[k] for k in range(3)) for i in range(3)]
    seen = slot >= 0
    low, high = [
        jnp.stack([edge(jnp.where(seen, v, far), -1) for v in q], -1)
        for edge, far in ((jnp.min, shapes.FAR), (jnp.max, -shapes.FAR))
    ]
    size = jnp.asarray(scene.size, jnp.float32)
    boxes = c, R, jnp.asarray(scene.axes, jnp.float32), jnp.asarray(scene.rounding, jnp.float32)
    hides = tiles.over(low, high, *boxes)
    shaded = jnp.zeros_like(seen)
    for kind in (scenes.CAPSULE, scenes.CYLINDER, scenes.BOX):
        of = scene.slots(kind)
        if not of:
            continue
        mine = slice(of.start, of.stop)

        def hide(shaded, other, features, kind=kind):
            hidden = shapes.shadow(kind, q, features)
            return shaded | (hidden & (other >= 0) & (other != slot))

        table = shapes.features(kind, c[mine], R[mine], size[mine])
        shaded = tiles.each(hides[:, mine], table, of.start, hide, shaded)
    return shaded


def _frame(z: np.ndarray) -> np.ndarray:
    """A rotation whose third row is the unit vector `z`, float32."""
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z]).astype(np.float32)
