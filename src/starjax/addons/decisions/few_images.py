"""Convolves one or two images as a matrix product of the shifted inputs.

Reference: `resnet.convolve`. On a GPU cuDNN's convolutions are launched one by one
between CUDA graphs, which takes longer than they run: 0.35 ms of a decision for one robot, whose
encoder sees two images.
"""

import jax
import jax.numpy as jnp
import numpy as np

from starjax.policies.models import kernels

_MOST = 2  # images


def pays(count: int) -> bool:
    """Returns whether products are faster here for `count` images."""
    return count <= _MOST and kernels.on_gpu()


def convolution(x: jax.Array, kernel: jax.Array, stride: int, pad: int) -> jax.Array:
    """Convolves `[N, h, w, C]` with `[rows, columns, C, features]`, `pad` zeros on every side."""
    sides = kernel.shape[:2]
    x = jnp.pad(x, ((0, 0), (pad, pad), (pad, pad), (0, 0)))
    down, right = (
        (side - size) // stride * stride + 1 for side, size in zip(x.shape[1:3], sides, strict=True)
    )
    shifted = [x[:, i : i + down : stride, j : j + right : stride] for i, j in np.ndindex(*sides)]
    columns = jnp.concatenate(shifted, -1)
    if sides == (1, 1):
        # XLA would fuse the strided slice into the product's kernel, and abort the process where
        # its sides are odd (jaxlib 0.11, 29 pixels to 15).
        columns = jax.lax.optimization_barrier(columns)
    return columns @ kernel.reshape(-1, kernel.shape[-1])
