"""Intersections of rays with capsules (and spheres), cylinders, boxes and planes.

A view ray is `t * (x, y, -1)`: `t` is planar depth. A shadow ray starts at a point and runs along
the third axis of the light frame. Each function takes the features of one geom, broadcast against
the pixels, in float32. It avoids differences of large squares, which keeps the outline of a 1 mm
capsule at half a metre within about 1e-3 px.
"""

import jax
import jax.numpy as jnp

from starjax.sim.camera import geometry as scenes

FAR = 2.0**20  # m, depth of a miss; a power of two survives the packing with a slot
NEAR = 1e-4  # m, nothing closer to the camera is drawn
SKIN = 2e-5  # m, a shadow ray starts this far above its surface
_TINY = 1e-9
_DISTANT = 1e6  # m, the centre of the ball that stands for a flat face

Array = jax.Array


def features(kind: int, c: Array, R: Array, size: Array) -> Array:
    """Returns the features `[N, 16]` of geoms of one kind for `view` and `shadow`.

    Args:
      c: `[N, 3]` centres in m.
      R: `[N, 3, 3]` orientations, both in the camera (for `view`) or light frame (for `shadow`).
      size: `[N, 3]` as in `RenderScene`.
    """
    if kind in (scenes.CAPSULE, scenes.CYLINDER):
        u = R[:, :, 2]
        along, square = -jnp.sum(c * u, -1), jnp.sum(c * c, -1)
        rest = jnp.stack([along, square, size[:, 0], size[:, 1]], -1)
        columns = [c, u, jnp.cross(c, u), rest]
    else:
        columns = [-jnp.einsum("gji,gj->gi", R, c, precision="highest"), R.reshape(-1, 9), size]
    table = jnp.concatenate(columns, -1)
    return jnp.pad(table, ((0, 0), (0, 16 - table.shape[1])))


def view(kind: int, x: Array, y: Array, f: list[Array]) -> tuple[Array, Array | int]:
    """Intersects rays through (x, y, -1) with a geom: depth in m (FAR for a miss) and face."""
    return (_view_capsule, _view_cylinder, _view_box, _view_plane)[kind](x, y, f)


def shadow(kind: int, p: list[Array], f: list[Array]) -> Array:
    """Returns True for points `p`, in the light frame, below a capsule, cylinder or box."""
    return (_shadow_capsule, _shadow_cylinder, _shadow_box)[kind](p, f)


def normals(kind: int, c: Array, R: Array, size: Array) -> Array:
    """Returns each face's field of normals `[N * FACES[kind], 7]` as (c, u, half) of `normal`.

    Args:
      c, R, size: as for `features`, in the camera frame.
    """
    u, half = R[:, :, 2], size[:, 1]
    if kind == scenes.CAPSULE:
        return jnp.concatenate([c, u, half[:, None]], -1)
    # Only one of two opposite faces is visible, the one towards the camera.
    facing = R * jnp.where(jnp.einsum("gij,gi->gj", R, c) < 0, 1.0, -1.0)[:, None]
    flat = -_DISTANT * jnp.swapaxes(facing, 1, 2)  # `[N, 3, 3]`, one row a face
    flat = jnp.pad(flat, ((0, 0), (0, 0), (0, 4)))
    if kind == scenes.CYLINDER:
        side = jnp.concatenate([c, u, jnp.full_like(half, FAR)[:, None]], -1)
        return jnp.stack([side, flat[:, 2]], 1).reshape(-1, 7)
    return flat[:, 2] if kind == scenes.PLANE else flat.reshape(-1, 7)


def normal(p: list[Array], f: list[Array]) -> list[Array]:
    """Returns the unit normal at points `p` of a face, away from the nearest point of its axis.

    Capsule and cylinder differ in the length of the axis; a flat face is a ball far behind it.
    """
    w = [p[k] - f[k] for k in range(3)]
    along = jnp.clip(w[0] * f[3] + w[1] * f[4] + w[2] * f[5], -f[6], f[6])
    w = [w[k] - along * f[3 + k] for k in range(3)]
    scale = jax.lax.rsqrt(jnp.maximum(w[0] * w[0] + w[1] * w[1] + w[2] * w[2], 1e-18))
    return [v * scale for v in w]


def _round(x, y, f):
    """Intersects a ray with the infinite cylinder around an axis, for capsule and cylinder."""
    cx, cy, cz, ux, uy, uz, wx, wy, wz, n, _, r, _ = f[:13]
    square = x * x + y * y + 1
    m = x * ux + y * uy - uz
    away = cz - x * cx - y * cy
    # a t^2 + 2 b t + c = 0 is the distance from the axis squared minus r^2. Its discriminant
    # b^2 - a c = a r^2 - s^2, by Lagrange's identity, has no difference of large squares.
    a = jnp.maximum(square - m * m, _TINY)
    b = away - m * n
    s = x * wx + y * wy - wz  # product of ray and axis: the distance between them times sqrt(a)
    h = a * r * r - s * s
    t = (-b - jnp.sqrt(jnp.maximum(h, 0.0))) / a
    return square, m, away, a, b, s, h, t


def _view_capsule(x, y, f):
    n, oc2, r, half = f[9:13]
    square, m, away, _, _, _, h, t = _round(x, y, f)
    # Beyond the cylinder's ends the ray meets the ball at the nearer end.
    along = n + t * m
    end = jnp.where(along > 0, half, -half)  # centre of the ball at that end
    b = away - end * m  # the ray against the ball: square t^2 + 2 b t + c = 0
    h_end = b * b - square * (oc2 - 2 * end * n + half * half - r * r)
    t_end = (-b - jnp.sqrt(jnp.maximum(h_end, 0.0))) / square
    t = jnp.where(
        (h > 0) & (jnp.abs(along) <= half), t, jnp.where((h > 0) & (h_end > 0), t_end, FAR)
    )
    return jnp.where(t > NEAR, t, FAR), 0


def _view_cylinder(x, y, f):
    n, _, r, half = f[9:13]
    _, m, _, a, b, s, h, t = _round(x, y, f)
    on_side = (h > 0) & (jnp.abs(n + t * m) <= half) & (t > NEAR)
    m = jnp.where(jnp.abs(m) < _TINY, _TINY, m)
    t_disc = (-jnp.sign(m) * half - n) / m  # where the ray meets the plane of the nearer cap
    across = a * t_disc + b  # a times the ray's own part of the distance from the axis
    on_disc = (across * across + s * s <= a * r * r) & (t_disc > NEAR)
    return jnp.where(on_side, t, jnp.where(on_disc, t_disc, FAR)), jnp.where(on_side, 0, 1)


def _local(x, y, f):
    """Returns the rays' direction in the frame of a box or plane."""
    return [x * f[3 + k] + y * f[6 + k] - f[9 + k] for k in range(3)]


def _inverse(v):
    return 1.0 / jnp.where(jnp.abs(v) < _TINY, _TINY, v)


def _view_box(x, y, f):
    # Slab method: the ray is inside while it is between all three pairs of faces.
    near, far, face = -FAR, FAR, 0
    for k, v in enumerate(_local(x, y, f)):
        inverse = _inverse(v)
        middle, width = -f[k] * inverse, jnp.abs(inverse) * f[12 + k]  # the slab's entry and exit
        enter = middle - width
        face = jnp.where(enter > near, k, face)
        near, far = jnp.maximum(near, enter), jnp.minimum(far, middle + width)
    return jnp.where((near <= far) & (near > NEAR), near, FAR), face


def _view_plane(x, y, f):
    v = _local(x, y, f)
    t = -f[2] * _inverse(v[2])  # height over the plane / speed towards it
    inside = (jnp.abs(f[0] + t * v[0]) <= f[12]) & (jnp.abs(f[1] + t * v[1]) <= f[13])
    return jnp.where((v[2] < 0) & (t > NEAR) & inside, t, FAR), 0


def _shadow_capsule(p, f):
    cx, cy, cz, ux, uy, uz = f[:6]
    r, half = f[11], f[12]
    dx, dy = p[0] - cx, p[1] - cy
    # Point of the axis nearest to the light ray. It is inside the capsule, so a point outside is in
    # shadow exactly if it lies below.
    along = (dx * ux + dy * uy) / jnp.maximum(ux * ux + uy * uy, _TINY)
    along = jnp.clip(along, -half, half)
    dx, dy = dx - along * ux, dy - along * uy  # across, seen along the light
    return (dx * dx + dy * dy < r * r) & (cz + along * uz > p[2] + SKIN)


def _shadow_cylinder(p, f):
    cx, cy, cz, ux, uy, uz = f[:6]
    r, half = f[11], f[12]
    ox, oy, oz = p[0] - cx, p[1] - cy, p[2] - cz
    n = ox * ux + oy * uy + oz * uz
    a = jnp.maximum(1 - uz * uz, _TINY)
    b = oz - uz * n
    s = ox * uy - oy * ux
    root = jnp.sqrt(jnp.maximum(a * r * r - s * s, 0.0))
    inverse = _inverse(uz)
    middle, width = -n * inverse, jnp.abs(inverse) * half
    enter = jnp.maximum((-b - root) / a, middle - width)
    leave = jnp.minimum((-b + root) / a, middle + width)
    return (a * r * r > s * s) & (leave > jnp.maximum(enter, SKIN))


def _shadow_box(p, f):
    enter, leave = SKIN, FAR
    for k in range(3):
        inverse = _inverse(f[9 + k])
        o = f[k] + p[0] * f[3 + k] + p[1] * f[6 + k] + p[2] * f[9 + k]
        middle, width = -o * inverse, jnp.abs(inverse) * f[12 + k]
        enter, leave = jnp.maximum(enter, middle - width), jnp.minimum(leave, middle + width)
    return leave > enter
