"""Colour of the visible points: MuJoCo's fixed-function lighting, evaluated at every sample."""

import jax
import jax.numpy as jnp
import numpy as np

from starjax.sim.camera import scene as scenes
from starjax.sim.camera import shapes, tiles

Array = jax.Array


def light(
    scene: scenes.Scene, grid: tiles.Grid, textures: dict[int, np.ndarray], rgb: Array, c: Array,
    R: Array, t: Array, face: Array, shaded: Array,
) -> Array:  # fmt: skip
    """Lit colour of every sample, `[T, Q]` int32 with red in the lowest byte.

    Each tile paints the faces that it sees one after the other, so that nothing is looked up by
    sample and the whole of the lighting is one pass over memory.

    Args:
      textures: by row, its texture as every sample sees it, `[3, T, Q]`.
      rgb: `[N, 3]` colour of every row.
      c, R: `[N, 3]` m and `[N, 3, 3]` geom poses in the camera frame.
      t, face: `[T, Q]` depth in m and visible face, -1 for the background.
      shaded: `[T, Q]` bool, in the sun's shadow.
    """
    row = scene.row_of_face()
    looks = np.stack([scene.specular, scene.exponent, scene.emission], 1).astype(np.float32)
    table = jnp.concatenate([_normals(scene, c, R), rgb[row], jnp.asarray(looks[row])], -1)

    def paint(word, mine, f, face, shaded, t, x, y, *texels):
        p = [x * t, y * t, -t]
        lit = _lit(scene, p, shapes.normal(p, f[:7]), shaded, f[7:10], f[10:])
        for i, r in enumerate(textures):
            on = (mine >= np.argmax(row == r)) & (mine < np.argmax(row == r) + np.sum(row == r))
            lit = [jnp.where(on, v * texels[3 * i + k], v) for k, v in enumerate(lit)]
        return jnp.where((face == mine) & (mine >= 0), _word(lit), word)

    texels = [jnp.asarray(component) for texture in textures.values() for component in texture]
    x, y = jnp.asarray(grid.x), jnp.asarray(grid.y)
    background = jnp.broadcast_to(_word([jnp.float32(v) for v in scene.background]), t.shape)
    words = tiles.present(face, len(row))
    return tiles.each(words, table, paint, background, face, shaded, t, x, y, *texels)


def _lit(
    scene: scenes.Scene, p: list[Array], normal: list[Array], shaded: Array, colour: list[Array],
    look: list[Array],
) -> list[Array]:  # fmt: skip
    """Red, green and blue in [0, 1]; each light is clipped at 1, as by GL's passes."""
    specular, exponent, emission = look
    lit = [emission * base for base in colour]
    for source in (scene.headlight, scene.sun):
        if source is None:
            continue
        diffuse, shine = _reflect(source, p, normal, exponent)
        for k, base in enumerate(colour):
            part = base * (float(source.ambient[k]) + float(source.diffuse[k]) * diffuse)
            if shine is not None:
                part += specular * float(source.specular[k]) * shine
            if source is scene.sun:
                part = jnp.where(shaded, 0.0, part)
            lit[k] = jnp.minimum(lit[k] + part, 1.0)
    return lit


def _reflect(
    source: scenes.Light, p: list[Array], normal: list[Array], exponent: Array
) -> tuple[Array, Array | None]:
    """Diffuse and, if any, specular factor of a directional light (Blinn and Phong)."""
    to_light = [-float(v) for v in source.direction]
    diffuse = jnp.maximum(sum(n * v for n, v in zip(normal, to_light)), 0.0)
    if not np.any(source.specular > 0):
        return diffuse, None
    near = jax.lax.rsqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
    half = [v - near * x for v, x in zip(to_light, p)]
    norm = jax.lax.rsqrt(jnp.maximum(sum(h * h for h in half), 1e-12))
    cosine = jnp.clip(sum(n * h for n, h in zip(normal, half)) * norm, 1e-6, 1.0)
    return diffuse, jnp.where(diffuse > 0, jnp.exp2(exponent * jnp.log2(cosine)), 0.0)


def _normals(scene: scenes.Scene, c: Array, R: Array) -> Array:
    """`shapes.normals` of all faces in their order, `[F, 7]`."""
    size = jnp.asarray(scene.size, jnp.float32)
    kinds = [(kind, scene.rows(kind)) for kind in range(4)]
    return jnp.concatenate([shapes.normals(k, c[rows], R[rows], size[rows]) for k, rows in kinds])


def _word(rgb: list[Array]) -> Array:
    """Red, green and blue in [0, 1] as the bytes of an int32."""
    red, green, blue = [(v * 255 + 0.5).astype(jnp.int32) for v in rgb]
    return red | green << 8 | blue << 16
