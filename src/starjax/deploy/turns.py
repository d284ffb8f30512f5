"""Rotation vectors `[..., 3]` rad between orientations, in the frame of the first."""

import jax
from jax.scipy.spatial.transform import Rotation

from starjax import rcm
from starjax.rcm import arrays


def between(R: jax.Array, other: jax.Array) -> jax.Array:
    """Returns the rotation vector from `R` to `other`, both `[..., 3, 3]`."""
    return Rotation.from_matrix(arrays.matmul(R.mT, other)).as_rotvec()


def part(R: jax.Array, turn: jax.Array, fraction: jax.Array) -> jax.Array:
    """Turns `R` by a fraction `[...]` of a rotation vector."""
    return arrays.matmul(R, Rotation.from_rotvec(fraction[..., None] * turn).as_matrix())


def orthonormal(R: jax.Array) -> jax.Array:
    """Returns the rotation near `R`, a measured or transmitted one with small errors."""
    return rcm.rot6d_decode(rcm.rot6d_encode(R))
