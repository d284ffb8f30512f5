"""Disturbances of cameras and images, as pure functions of one pose or one image."""

import jax
import jax.numpy as jnp
from jax.scipy.spatial.transform import Rotation

from starjax.core.types import Pose
from starjax.evaluation.disturbances.base import Disturbance, DisturbanceState
from starjax.evaluation.disturbances.draws import directions

TURN_PER_MM = 0.5  # deg that a camera is turned per mm that it is moved
MAX_BLUR = 4  # px to either side; fixes the shapes of the programs
PATCHES = 12  # patches of blood
BLOOD_RGB, SHINE_RGB = (0.42, 0.03, 0.03), (0.97, 0.93, 0.9)
SHINE = 0.25  # radius of a patch's reflection, as a fraction of the patch's radius
SHINE_OFFSET = 0.4  # shift of the reflection to the top left, towards the light, likewise


def _displace(disturbance: DisturbanceState, cameras: Pose) -> Pose:
    key_p, key_R = jax.random.split(disturbance.key)
    direction, axis = directions(key_p, cameras.p), directions(key_R, cameras.p)
    turn = Rotation.from_rotvec(jnp.deg2rad(TURN_PER_MM * disturbance.level) * axis).as_matrix()
    R = jnp.einsum("cij,cjk->cik", cameras.R, turn, precision="highest")
    return Pose(R, cameras.p + 1e-3 * disturbance.level * direction)


def _shows_tissue(disturbance: DisturbanceState) -> jax.Array:
    return jax.random.uniform(disturbance.key) < disturbance.level


def _tint(disturbance: DisturbanceState, image: jax.Array, step: jax.Array) -> jax.Array:
    cast = jax.random.uniform(disturbance.key, (3,), minval=-1.0)
    # The most affected colour changes by `level`.
    return image * (1.0 + disturbance.level * cast / jnp.max(jnp.abs(cast)))


def _add_noise(disturbance: DisturbanceState, image: jax.Array, step: jax.Array) -> jax.Array:
    noise = jax.random.normal(jax.random.fold_in(disturbance.key, step), image.shape)
    return image + disturbance.level * noise


def _blur(disturbance: DisturbanceState, image: jax.Array, step: jax.Array) -> jax.Array:
    """Averages over a square with `level` pixels to either side, cut off at the image's edges."""
    offsets = jnp.arange(-MAX_BLUR, MAX_BLUR + 1)
    weights = (jnp.abs(offsets) <= jnp.round(disturbance.level)).astype(jnp.float32)

    def sum_along(x: jax.Array, axis: int) -> jax.Array:
        pad = [(MAX_BLUR, MAX_BLUR) if i == axis else (0, 0) for i in range(x.ndim)]
        padded, size = jnp.pad(x, pad), x.shape[axis]
        parts = [
            weight * jax.lax.slice_in_dim(padded, i, i + size, axis=axis)
            for i, weight in enumerate(weights)
        ]
        return sum(parts, jnp.zeros_like(x))

    def box_sum(x: jax.Array) -> jax.Array:  # separable: rows, then columns
        return sum_along(sum_along(x, 0), 1)

    return box_sum(image) / box_sum(jnp.ones_like(image))


def _stain(disturbance: DisturbanceState, image: jax.Array, step: jax.Array) -> jax.Array:
    """Covers a fraction `level` of the image, on average, with round patches and reflections.

    Patches wrap around the image's edges.
    """
    height, width, _ = image.shape
    centres = jax.random.uniform(disturbance.key, (PATCHES, 2))
    # A point stays free with probability (1 - pi r^2)^PATCHES = 1 - level: patches are independent.
    radius = jnp.sqrt((1.0 - (1.0 - disturbance.level) ** (1.0 / PATCHES)) / jnp.pi)
    rows, columns = (jnp.arange(height) + 0.5) / height, (jnp.arange(width) + 0.5) / width

    def squares(points: jax.Array, centres: jax.Array) -> jax.Array:
        return ((points - centres[:, None] + 0.5) % 1.0 - 0.5) ** 2  # on the torus

    def covered(centres: jax.Array, radius: jax.Array) -> jax.Array:
        # Squares along each axis first: a remainder for every pixel would take 30 times as long.
        down, across = squares(rows, centres[:, 0]), squares(columns, centres[:, 1])
        return jnp.any(down[:, :, None] + across[:, None] < radius**2, 0)[..., None]

    stained = jnp.where(covered(centres, radius), jnp.array(BLOOD_RGB), image)
    shines = covered(centres - SHINE_OFFSET * radius, SHINE * radius)
    return jnp.where(shines, jnp.array(SHINE_RGB), stained)


CAMERA = Disturbance(
    description=f"the camera is displaced, and rotated by {TURN_PER_MM:g} degrees per mm",
    unit="mm",
    levels=(0.0, 2.0, 5.0, 10.0),
    on_camera=_displace,
)
LOOK = Disturbance(
    description="this fraction of the episodes shows a body cavity, by the lamp of an endoscope",
    unit="",
    levels=(0.0, 1.0),
    max_level=1.0,
    on_look=_shows_tissue,
)
DARKNESS = Disturbance(
    description="the light is dimmed by this fraction",
    unit="",
    levels=(0.0, 0.1, 0.2, 0.4),
    max_level=1.0,
    on_image=lambda disturbance, image, step: (1.0 - disturbance.level) * image,
)
TINT = Disturbance(
    description="the lens tints the image: each colour channel is scaled by up to this fraction",
    unit="",
    levels=(0.0, 0.1, 0.2, 0.4),
    max_level=1.0,
    on_image=_tint,
)
NOISE = Disturbance(
    description="every channel of every pixel has Gaussian noise of this fraction of its range",
    unit="",
    levels=(0.0, 0.02, 0.05, 0.1),
    on_image=_add_noise,
)
BLUR = Disturbance(
    description="the image is out of focus by this many pixels to either side",
    unit="px",
    levels=(0.0, 1.0, 2.0),
    max_level=float(MAX_BLUR),
    on_image=_blur,
)
SMOKE = Disturbance(
    description="white smoke replaces this fraction of the image's contrast",
    unit="",
    levels=(0.0, 0.1, 0.25, 0.5),
    max_level=1.0,
    on_image=lambda disturbance, image, step: (1.0 - disturbance.level) * image + disturbance.level,
)
BLOOD = Disturbance(
    description="shining patches of blood cover this fraction of the image",
    unit="",
    levels=(0.0, 0.05, 0.1, 0.2),
    max_level=0.9,
    on_image=_stain,
)
