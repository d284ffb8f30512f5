"""Small linear systems as plain array operations.

`jax.scipy.linalg` calls LAPACK or cuSOLVER. For a batch of matrices of order 14 their launch costs
more than the arithmetic (on an H200 a step of 360 environments in contact takes 0.94 ms with them,
0.67 without), and jaxlib 0.10's batched Cholesky may hang on two CPU cores.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

# Order from which the elimination is a loop: unrolled, it takes a minute to compile at 62.
LOOP_FROM = 60


def solve_positive(H: jax.Array, g: jax.Array) -> jax.Array:
    """Solves H x = g `[N]` for a symmetric positive definite H `[N, N]`, single-sample.

    Gauss-Jordan elimination without pivoting, stable for such an H. Not finite for a singular H.
    """
    rows = jnp.concatenate([H, g[:, None]], axis=1)
    index = np.arange(len(g))[:, None]
    if len(g) >= LOOP_FROM:

        def eliminate(i: jax.Array, rows: jax.Array) -> jax.Array:
            column = jax.lax.dynamic_slice_in_dim(rows, i, 1, axis=1)
            pivot = rows[i] / rows[i, i]
            return jnp.where(index == i, pivot, rows - column * pivot)

        return jax.lax.fori_loop(0, len(g), eliminate, rows)[:, -1]
    for i in range(len(g)):
        pivot = rows[i] / rows[i, i]
        rows = jnp.where(index == i, pivot, rows - rows[:, i : i + 1] * pivot)
    return rows[:, -1]


def solve_tridiagonal(a: jax.Array, b: jax.Array, c: jax.Array, d: jax.Array) -> jax.Array:
    """Solves a_i x_(i-1) + b_i x_i + c_i x_(i+1) = d_i, all `[N]`, a_0 = c_(N-1) = 0.

    Without pivoting, for a diagonal that dominates. One equation after another on a CPU, where 16
    systems of 31 take a ninth of the time of all at once.
    """
    return jax.lax.platform_dependent(a, b, c, d, cpu=in_turn, default=at_once)


def in_turn(a: jax.Array, b: jax.Array, c: jax.Array, d: jax.Array) -> jax.Array:
    """Solves a tridiagonal system by elimination from the first equation to the last."""

    def eliminate(above: Any, row: Any) -> Any:
        (c_above, d_above), (a, b, c, d) = above, row
        scale = 1.0 / (b - a * c_above)
        below = c * scale, (d - a * d_above) * scale
        return below, below

    zero = jnp.zeros_like(d[0])
    _, rows = jax.lax.scan(eliminate, (zero, zero), (a, b, c, d))

    def insert(x: jax.Array, row: Any) -> tuple[jax.Array, jax.Array]:
        x = row[1] - row[0] * x
        return x, x

    return jax.lax.scan(insert, zero, rows, reverse=True)[1]


def at_once(a: jax.Array, b: jax.Array, c: jax.Array, d: jax.Array) -> jax.Array:
    """Solves a tridiagonal system by parallel cyclic reduction, in log2 N rounds."""
    a, c, d = a / b, c / b, d / b
    reach = 1
    # A round replaces neighbours by those twice as far. Beyond the ends coefficients are 0: rows
    # that `roll` brings round do not count.
    while reach < len(b):
        (a0, c0, d0), (a1, c1, d1) = (
            [jnp.roll(x, by) for x in (a, c, d)] for by in (reach, -reach)
        )
        scale = 1.0 / (1.0 - a * c0 - c * a1)
        a, c, d = -scale * a * a0, -scale * c * c1, scale * (d - a * d0 - c * d1)
        reach *= 2
    return d
