"""Colour of the visible points: MuJoCo's fixed-function lighting, evaluated at every pixel."""

import jax
import jax.numpy as jnp
import numpy as np

from starjax.sim.camera import scene as scenes

Array = jax.Array


def light(
    scene: scenes.Scene, rgb: Array, c: Array, R: Array, p: list[Array], slot: Array, shaded: Array,
    footprint: float,
) -> Array:  # fmt: skip
    """Lit colour `[..., 3]` in [0, 1].

    Args:
      rgb: `[N, 3]` colour of every slot.
      c, R: `[N, 3]` m and `[N, 3, 3]` geom poses in the camera frame.
      p: x, y, z of the visible points in the camera frame; `[...]` m each.
      slot: `[...]` of the visible geom, -1 for the background.
      shaded: `[...]` bool, in the sun's shadow.
      footprint: width of a sample over its depth.
    """
    at = jnp.maximum(slot, 0)
    centre, frame = [[_pick(c[:, k], at) for k in range(3)], [
        [_pick(R[:, i, k], at) for k in range(3)] for i in range(3)
    ]]  # fmt: skip
    offset = [p[k] - centre[k] for k in range(3)]
    local = [sum(offset[i] * frame[i][k] for i in range(3)) for k in range(3)]
    normal = _normal(scene, at, local, frame, p)
    colour = [_pick(rgb[:, k], at) for k in range(3)]
    texture = _texture(scene, slot, local, normal, p, footprint)

    eye_norm = jax.lax.rsqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
    eye = [-v * eye_norm for v in p]
    lit = [_pick(_constant(scene.emission), at) * v for v in colour]
    lit = _add(scene, lit, scene.headlight, at, colour, normal, eye, None)
    lit = [jnp.minimum(v, 1.0) for v in lit]
    if scene.sun is not None:
        lit = _add(scene, lit, scene.sun, at, colour, normal, eye, shaded)
    out = [jnp.clip(v * t, 0.0, 1.0) for v, t in zip(lit, texture)]
    background = [jnp.float32(v) for v in scene.background]
    return jnp.stack([jnp.where(slot < 0, b, v) for v, b in zip(out, background)], -1)


def _pick(column: Array, at: Array) -> Array:
    """A value by slot; a column that is the same for all slots costs nothing."""
    return column.at[at].get(mode="promise_in_bounds") if column.ndim else column


def _constant(column: np.ndarray) -> Array:
    same = np.all(column == column[0])
    return jnp.asarray(column[0] if same else column, jnp.float32)


def _normal(scene, at, local, frame, p) -> list[Array]:
    """Unit normal towards the camera, `[...]` by component, from the point in the geom's frame."""
    size = [_pick(jnp.asarray(scene.size[:, k], jnp.float32), at) for k in range(3)]
    kind = _pick(jnp.asarray(scene.kind, jnp.int32), at)
    x, y, z = local
    radial = jnp.sqrt(jnp.maximum(x * x + y * y, 1e-18))
    on_disc = (kind == scenes.CYLINDER) & (jnp.abs(z) - size[1] > radial - size[0])
    beyond = jnp.where(kind == scenes.CAPSULE, z - jnp.clip(z, -size[1], size[1]), 0.0)
    inside = [jnp.abs(v) - s for v, s in zip(local, size)]
    face_x = (inside[0] > inside[1]) & (inside[0] > inside[2])
    face_y = ~face_x & (inside[1] > inside[2])
    flat = kind >= scenes.BOX
    one = jnp.ones_like(x)
    n = [
        jnp.where(flat, one * face_x, jnp.where(on_disc, 0.0, x)),
        jnp.where(flat, one * face_y, jnp.where(on_disc, 0.0, y)),
        jnp.where(flat, one * ~(face_x | face_y), jnp.where(on_disc, 1.0, beyond)),
    ]
    n = [sum(frame[i][k] * n[k] for k in range(3)) for i in range(3)]
    towards = -(n[0] * p[0] + n[1] * p[1] + n[2] * p[2])
    norm = jax.lax.rsqrt(jnp.maximum(n[0] * n[0] + n[1] * n[1] + n[2] * n[2], 1e-18))
    return [v * norm * jnp.where(towards < 0, -1.0, 1.0) for v in n]


def _add(scene, lit, source: scenes.Light, at, colour, normal, eye, shaded) -> list[Array]:
    """Adds one directional light (Blinn-Phong); `shaded` switches it off."""
    to_light = [-float(v) for v in source.direction]
    diffuse = jnp.maximum(sum(n * v for n, v in zip(normal, to_light)), 0.0)
    visible = 1.0 if shaded is None else jnp.where(shaded, 0.0, 1.0)
    total = [
        c * (float(a) + float(d) * diffuse)
        for c, a, d in zip(colour, source.ambient, source.diffuse)
    ]
    if np.any(source.specular > 0) and np.any(scene.specular > 0):
        half = [v + e for v, e in zip(to_light, eye)]
        norm = jax.lax.rsqrt(jnp.maximum(sum(h * h for h in half), 1e-12))
        cosine = jnp.clip(sum(n * h for n, h in zip(normal, half)) * norm, 1e-6, 1.0)
        shine = jnp.exp2(_pick(_constant(scene.exponent), at) * jnp.log2(cosine))
        shine = jnp.where(diffuse > 0, shine, 0.0) * _pick(_constant(scene.specular), at)
        total = [t + float(s) * shine for t, s in zip(total, source.specular)]
    return [v + visible * t for v, t in zip(lit, total)]


def _texture(scene, slot, local, normal, p, footprint) -> list[Array]:
    """Texture colour, 1 where there is none; averaged over the sample's footprint."""
    colour = [jnp.ones_like(local[0])] * 3
    if not scene.textures:
        return colour
    depth = -p[2]
    slant = jnp.abs(normal[0] * p[0] + normal[1] * p[1] + normal[2] * p[2]) / depth
    width = footprint * depth / jnp.maximum(slant, 0.1)
    for texture in scene.textures:
        u, v = [local[k] * float(texture.repeat[k]) + float(texture.origin[k]) for k in range(2)]
        blur = [jnp.maximum(width * abs(float(r)), 1e-4) for r in texture.repeat]
        square = _wave(u, blur[0]) * _wave(v, blur[1])
        gap = [1 - _line(s, b, texture.line_width) for s, b in zip((u, v), blur)]
        line = 1 - gap[0] * gap[1]
        for k in range(3):
            even, odd = (float(c) for c in texture.colours[:, k])
            cell = (even + odd) / 2 + (even - odd) / 2 * square
            cell += (float(texture.line[k]) - cell) * line
            colour[k] = jnp.where(slot == texture.slot, cell, colour[k])
    return colour


def _wave(u: Array, width: Array) -> Array:
    """Square wave of period 1 (+1 in the first half), averaged over a window of `width`."""

    def integral(v):
        return 0.5 - jnp.abs(v - jnp.floor(v) - 0.5)

    return (integral(u + width / 2) - integral(u - width / 2)) / width


def _line(u: Array, width: Array, line_width: float) -> Array:
    """Part of a window of `width` around u covered by lines centred on the integers."""
    if line_width == 0:
        return jnp.zeros_like(u)

    def integral(v):
        v = v + line_width / 2
        return jnp.floor(v) * line_width + jnp.minimum(v - jnp.floor(v), line_width)

    return (integral(u + width / 2) - integral(u - width / 2)) / width
