"""Image of a scene: the nearest face along every ray, the sun's shadow, the colour."""

import jax
import jax.numpy as jnp

from starjax.sim.camera import geometry as scenes
from starjax.sim.camera import rays, shade, tiles
from starjax.sim.camera.viewpoint import View

Array = jax.Array


def cast(
    scene: scenes.RenderScene, grid: tiles.Grid, view: View, shadow: bool,
    geom_xpos: Array, geom_xmat: Array, geom_rgb: Array,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Returns depth in m, face (-1 background) and colour (bytes of an int32), each `[T, Q]`."""
    offset = geom_xpos[scene.ids] - view.p_world_cam  # m, [N, 3]
    c = jnp.einsum("ij,gj->gi", view.R_cam_world, offset, precision="highest")
    R = jnp.einsum("ij,gjk->gik", view.R_cam_world, geom_xmat[scene.ids], precision="highest")
    t, face = _nearest(scene, grid, c, R)
    shaded = jnp.zeros_like(face, bool)
    if shadow and view.R_light_cam is not None:
        shaded = _shaded(scene, grid, view.R_light_cam, c, R, t, face)
    depth = jnp.where(face >= 0, t, 1.0)  # any finite number for the background
    p = [grid.x * depth, grid.y * depth, -depth]  # the camera looks along -z
    return t, face, shade.light(scene, view, geom_rgb[scene.ids], c, R, p, face, shaded)


def _nearest(
    scene: scenes.RenderScene, grid: tiles.Grid, c: Array, R: Array
) -> tuple[Array, Array]:
    """Returns depth in m and number of the first face that each ray meets."""
    # Both travel in one int32: positive floats order like their bits, and the last few bits of the
    # mantissa (2^-16 of the depth with 127 faces) hold the face.
    room = (1 << len(scene.row_of_face()).bit_length()) - 1
    x, y = jnp.asarray(grid.x), jnp.asarray(grid.y)

    def pack(t, face):
        return (jax.lax.bitcast_convert_type(t, jnp.int32) & ~room) | face  # [depth bits | face]

    visible = tiles.in_view(grid, c, R, *_bounds(scene))
    size = jnp.asarray(scene.size, jnp.float32)
    key = pack(jnp.full_like(x, rays.FAR), room)
    for kind in (scenes.CAPSULE, scenes.CYLINDER, scenes.BOX, scenes.PLANE):
        rows, first = scene.rows(kind), scene.first_face(kind)

        def meet(key, row, features, x, y, kind=kind, first=first):
            t, part = rays.view(kind, x, y, features)
            # The nearest is the smallest integer
            hit = pack(t, first + scenes.FACES[kind] * row + part)
            return jnp.where((row >= 0) & (hit < key), hit, key)

        table = rays.features(kind, c[rows], R[rows], size[rows])
        if kind == scenes.PLANE:  # few and everywhere
            for row, features in enumerate(table):
                key = meet(key, row, list(features), x, y)
        else:
            key = tiles.each(visible[:, rows], table, meet, key, x, y)
    t = jax.lax.bitcast_convert_type(key & ~room, jnp.float32)
    return t, jnp.where(t < rays.FAR, key & room, -1)


def _shaded(
    scene: scenes.RenderScene, grid: tiles.Grid, R_light_cam: Array, c: Array, R: Array, t: Array,
    face: Array,
) -> Array:  # fmt: skip
    """Returns True for visible points that another geom shades. No convex shape shades itself."""
    c = jnp.einsum("ij,gj->gi", R_light_cam, c, precision="highest")
    R = jnp.einsum("ij,gjk->gik", R_light_cam, R, precision="highest")
    x, y = jnp.asarray(grid.x), jnp.asarray(grid.y)

    def points(t, x, y):
        return [t * (i * x + j * y - k) for i, j, k in R_light_cam]  # R_light_cam (x, y, -1) t

    low, high = [
        jnp.stack([edge(jnp.where(face >= 0, q, far), -1) for q in points(t, x, y)], -1)
        for edge, far in ((jnp.min, rays.FAR), (jnp.max, -rays.FAR))
    ]
    hides = tiles.over(low, high, c, R, *_bounds(scene))  # geoms above a tile's visible points
    size = jnp.asarray(scene.size, jnp.float32)
    shaded = jnp.zeros_like(face, bool)
    for kind in (scenes.CAPSULE, scenes.CYLINDER, scenes.BOX):
        rows, first, parts = scene.rows(kind), scene.first_face(kind), scenes.FACES[kind]

        def hide(shaded, row, features, face, t, x, y, kind=kind, first=first, parts=parts):
            part = face - (first + parts * row)
            other = (row >= 0) & ((part < 0) | (part >= parts))  # faces of other geoms alone
            return shaded | (rays.shadow(kind, points(t, x, y), features) & other)

        table = rays.features(kind, c[rows], R[rows], size[rows])
        shaded = tiles.each(hides[:, rows], table, hide, shaded, face, t, x, y)
    return shaded


def _bounds(scene: scenes.RenderScene) -> tuple[Array, Array]:
    return jnp.asarray(scene.axes, jnp.float32), jnp.asarray(scene.rounding, jnp.float32)
