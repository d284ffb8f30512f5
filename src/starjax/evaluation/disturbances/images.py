"""Cameras that are elsewhere, and pictures that are not as they were."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.scipy.spatial.transform import Rotation

from starjax.evaluation.disturbances.base import Disturbance, Now
from starjax.evaluation.disturbances.draws import directions
from starjax.sim.state import Env, EnvState
from starjax.types import Observation, Pose

TURN_PER_MM = 0.5  # degrees that a camera is turned for each mm that it is moved
MOST_BLUR = 4  # px on either side: programs are of this size
PATCHES = 12  # of blood
BLOOD_RGB, SHINE_RGB = (0.42, 0.03, 0.03), (0.97, 0.93, 0.9)
SHINE = 0.25  # of a patch's radius; its reflection lies towards the light, up and to the left

Change = Callable[[Now, jax.Array, jax.Array], jax.Array]


def _move(env: Env, now: Now, state: EnvState) -> tuple[EnvState, Any]:
    key_p, key_R = jax.random.split(now.key)
    aside, axis = directions(key_p, state.cameras.p), directions(key_R, state.cameras.p)
    turn = Rotation.from_rotvec(jnp.deg2rad(TURN_PER_MM * now.level) * axis).as_matrix()
    R = jnp.einsum("cij,cjk->cik", state.cameras.R, turn, precision="highest")
    return state.replace(cameras=Pose(R, state.cameras.p + 1e-3 * now.level * aside)), ()


def _seen(change: Change) -> Callable[[Env, Now, EnvState], Observation]:
    """Changes every image `[h, w, 3]` in [0, 1], given the number of the control step."""

    def observe(env: Env, now: Now, state: EnvState) -> Observation:
        seen = env.observe(state)

        def one(image: jax.Array) -> jax.Array:
            changed = change(now, image.astype(jnp.float32) / 255.0, state.step)
            return jnp.round(255.0 * jnp.clip(changed, 0.0, 1.0)).astype(jnp.uint8)

        return seen._replace(images=jax.tree.map(one, seen.images))

    return observe


def _tinted(now: Now, image: jax.Array, step: jax.Array) -> jax.Array:
    cast = jax.random.uniform(now.key, (3,), minval=-1.0)
    return image * (1.0 + now.level * cast / jnp.max(jnp.abs(cast)))


def _noisy(now: Now, image: jax.Array, step: jax.Array) -> jax.Array:
    drawn = jax.random.normal(jax.random.fold_in(now.key, step), image.shape)
    return image + now.level * drawn


def _blurred(now: Now, image: jax.Array, step: jax.Array) -> jax.Array:
    """The mean over a square with `level` pixels on either side, as far as the image goes."""
    offsets = jnp.arange(-MOST_BLUR, MOST_BLUR + 1)
    weights = (jnp.abs(offsets) <= jnp.round(now.level)).astype(jnp.float32)

    def along(x: jax.Array, axis: int) -> jax.Array:
        pad = [(MOST_BLUR, MOST_BLUR) if i == axis else (0, 0) for i in range(x.ndim)]
        padded, size = jnp.pad(x, pad), x.shape[axis]
        parts = [
            weight * jax.lax.slice_in_dim(padded, i, i + size, axis=axis)
            for i, weight in enumerate(weights)
        ]
        return sum(parts, jnp.zeros_like(x))

    def total(x: jax.Array) -> jax.Array:
        return along(along(x, 0), 1)

    return total(image) / total(jnp.ones_like(image))


def _bloody(now: Now, image: jax.Array, step: jax.Array) -> jax.Array:
    """Round patches, each with a reflection, that hide `level` of the picture on average; what
    leaves it on one side comes in on the other."""
    height, width, _ = image.shape
    centres = jax.random.uniform(now.key, (PATCHES, 2))
    # Of patches that lie independently of each other all miss a point with 1 - level.
    radius = jnp.sqrt((1.0 - (1.0 - now.level) ** (1.0 / PATCHES)) / jnp.pi)
    rows, columns = (jnp.arange(height) + 0.5) / height, (jnp.arange(width) + 0.5) / width
    at = jnp.stack(jnp.meshgrid(rows, columns, indexing="ij"), -1)

    def covered(middle: jax.Array, size: jax.Array) -> jax.Array:
        apart = (at[:, :, None] - middle + 0.5) % 1.0 - 0.5
        return jnp.any(jnp.sum(apart**2, -1) < size**2, -1)[..., None]

    stained = jnp.where(covered(centres, radius), jnp.array(BLOOD_RGB), image)
    shines = covered(centres - 0.4 * radius, SHINE * radius)
    return jnp.where(shines, jnp.array(SHINE_RGB), stained)


CAMERA = Disturbance(
    what=f"the camera has been pushed aside, and turned by {TURN_PER_MM:g} degrees a mm",
    unit="mm",
    levels=(0.0, 2.0, 5.0, 10.0),
    begin=_move,
    moves_cameras=True,
    of_images=True,
)
DARKNESS = Disturbance(
    what="the light is dimmed by this share",
    unit="",
    levels=(0.0, 0.1, 0.2, 0.4),
    most=1.0,
    observe=_seen(lambda now, image, step: (1.0 - now.level) * image),
    of_images=True,
)
TINT = Disturbance(
    what="the lens colours the picture: red, green and blue are brighter or darker by this share",
    unit="",
    levels=(0.0, 0.1, 0.2, 0.4),
    most=1.0,
    observe=_seen(_tinted),
    of_images=True,
)
NOISE = Disturbance(
    what="every colour of every pixel is noisy, with this standard deviation of its range",
    unit="",
    levels=(0.0, 0.02, 0.05, 0.1),
    observe=_seen(_noisy),
    of_images=True,
)
BLUR = Disturbance(
    what="the picture is out of focus, by so many pixels on either side",
    unit="px",
    levels=(0.0, 1.0, 2.0),
    most=float(MOST_BLUR),
    observe=_seen(_blurred),
    of_images=True,
)
SMOKE = Disturbance(
    what="white smoke hides this share of what is seen",
    unit="",
    levels=(0.0, 0.1, 0.25, 0.5),
    most=1.0,
    observe=_seen(lambda now, image, step: (1.0 - now.level) * image + now.level),
    of_images=True,
)
BLOOD = Disturbance(
    what="shining patches of blood hide this share of the picture",
    unit="",
    levels=(0.0, 0.05, 0.1, 0.2),
    most=0.9,
    observe=_seen(_bloody),
    of_images=True,
)
