"""Colour of the visible points: MuJoCo's fixed-function lighting, evaluated at every sample."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from starjax.sim.camera import geometry as scenes
from starjax.sim.camera import rays
from starjax.sim.camera.viewpoint import View

Array = jax.Array


def light(
    scene: scenes.RenderScene, view: View, rgb: Array, c: Array, R: Array,
    p: list[Array], face: Array, shaded: Array,
) -> Array:  # fmt: skip
    """Returns the lit colour of every sample, `[T, Q]` int32 with red in the lowest byte.

    Args:
      view: the camera's.
      rgb: `[N, 3]` colour of every row.
      c, R: `[N, 3]` m and `[N, 3, 3]` geom poses in the camera frame.
      p: x, y, z of the visible points in the camera frame; `[T, Q]` m each.
      face: `[T, Q]` visible face, -1 for the background.
      shaded: `[T, Q]` bool, in the sun's shadow.
    """
    row, at = scene.row_of_face(), jnp.maximum(face, 0)
    field = _normals(scene, c, R)
    normal = rays.normal(p, [_pick(field[:, k], at) for k in range(7)])
    specular, exponent, emission = [
        _constant(v[row]) for v in (scene.specular, scene.exponent, scene.emission)
    ]
    lights = [source for source in (scene.headlight, scene.sun) if source is not None]
    ways = [[-float(v) for v in scene.headlight.direction], view.to_sun]
    terms = [
        _reflect(source, to_light, p, normal, _pick(exponent, at))
        for source, to_light in zip(lights, ways)
    ]
    on = {r: _between(face, np.flatnonzero(row == r)) for r in view.textures}
    # The barrier computes these once; fusion would repeat them for each of the three colours.
    at, terms = jax.lax.optimization_barrier((at, terms))

    textures = {r: look(p) for r, look in view.textures.items()}
    look, background = view.look, [float(c) for c in scene.background]
    if look is not None:
        ground = _between(face, np.flatnonzero(row == scene.ground))
        background = look.background
        if view.has_look is not None:
            background = jnp.where(view.has_look, jnp.array(background), scene.background)
        painted, lamp = jax.lax.optimization_barrier((look.paint(p, shaded), look.lamp(p)))
    word = jnp.zeros_like(face)
    for k in range(3):
        base = _pick(rgb[row, k], at)
        lit = _pick(emission, at) * base
        for source, (diffuse, shine) in zip(lights, terms):
            part = base * (float(source.ambient[k]) + float(source.diffuse[k]) * diffuse)
            if shine is not None:
                part += _pick(specular, at) * float(source.specular[k]) * shine
            if source is scene.sun:
                part = jnp.where(shaded, 0.0, part)
            lit = jnp.minimum(lit + part, 1.0)  # light by light, as GL's passes clip
        for r, texture in textures.items():
            lit = jnp.where(on[r], lit * texture[k], lit)
        if look is not None:
            with_look = jnp.where(ground, painted[k], jnp.minimum(lit * lamp, 1.0))
            has_look = view.has_look
            lit = with_look if has_look is None else jnp.where(has_look, with_look, lit)
        lit = jnp.where(face < 0, background[k], lit)
        word |= (lit * 255 + 0.5).astype(jnp.int32) << (8 * k)  # rounded, one byte a colour
    return word


def _normals(scene: scenes.RenderScene, c: Array, R: Array) -> Array:
    """Returns `rays.normals` of all faces in their order, `[F, 7]`."""
    size = jnp.asarray(scene.size, jnp.float32)
    kinds = [(kind, scene.rows(kind)) for kind in range(4)]
    return jnp.concatenate([rays.normals(k, c[rows], R[rows], size[rows]) for k, rows in kinds])


def _between(face: Array, faces: np.ndarray) -> Array:
    return (face >= int(faces[0])) & (face <= int(faces[-1]))


def _pick(column: Array, at: Array) -> Array:
    """Returns a value by face; a column with one value for all costs nothing."""
    return column.at[at].get(mode="promise_in_bounds") if column.ndim else column


def _constant(column: np.ndarray) -> Array:
    same = np.all(column == column[0])
    return jnp.asarray(column[0] if same else column, jnp.float32)


def _reflect(
    source: scenes.Light, to_light: Sequence[Any], p: list[Array], normal: list[Array],
    exponent: Array,
) -> tuple[Array, Array | None]:  # fmt: skip
    """Returns a directional light's diffuse and specular factor or None (Blinn-Phong)."""
    diffuse = jnp.maximum(sum(n * v for n, v in zip(normal, to_light)), 0.0)
    if not np.any(source.specular > 0):
        return diffuse, None
    near = jax.lax.rsqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2])  # 1 / distance from the camera
    half = [v - near * x for v, x in zip(to_light, p)]  # to the light + to the eye
    norm = jax.lax.rsqrt(jnp.maximum(sum(h * h for h in half), 1e-12))
    cosine = jnp.clip(sum(n * h for n, h in zip(normal, half)) * norm, 1e-6, 1.0)
    return diffuse, jnp.where(diffuse > 0, jnp.exp2(exponent * jnp.log2(cosine)), 0.0)
