"""What this machine can do: rates of a large matrix product and of a large copy, measured here.

A floor is work over one of these rates: no program is faster without doing less.
"""

from typing import NamedTuple

import _timing
import jax
import jax.numpy as jnp

AGAIN = 10  # products, or copies, in one call


class Rates(NamedTuple):
    """FLOP/s of a product in `dtype`; bytes/s of a copy, reads and writes counted."""

    flops: float
    bandwidth: float
    dtype: str

    def described(self) -> str:
        """One line."""
        products = f"matrix products in {self.dtype} {self.flops / 1e12:.4g} TFLOP/s"
        return f"{products}, copies {self.bandwidth / 1e9:.4g} GB/s"

    def facts(self) -> dict[str, float | str]:
        """For a result file."""
        return {
            "matmul_flop_per_s": self.flops,
            "matmul_dtype": self.dtype,
            "copy_bytes_per_s": self.bandwidth,
        }


def measure(dtype: str) -> Rates:
    """Rates of this device; on a GPU of sizes that neither its caches nor its launches decide."""
    big = jax.default_backend() != "cpu"
    n, count = (8192, 1 << 30) if big else (1024, 1 << 24)
    # Random, as a product of ones or zeros draws less power and runs faster than real ones.
    a = jax.random.normal(jax.random.key(0), (n, n)).astype(dtype)
    x = jnp.ones(count)
    # Many in a call: the call's own time vanishes in the rate.
    product = _timing.time_jitted(lambda a: _again(lambda b: a @ b / n, a), a, repeats=5)
    copy = _timing.time_jitted(lambda x: _again(lambda y: y + 1.0, x), x, repeats=5)
    return Rates(AGAIN * 2 * n**3 / product.min_s, AGAIN * 2 * x.nbytes / copy.min_s, dtype)


def _again(fn, x: jax.Array) -> jax.Array:
    return jax.lax.fori_loop(0, AGAIN, lambda _, x: fn(x), x)
