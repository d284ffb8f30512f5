"""An integer hash, for random bits where `jax.random` takes too long to compile or to draw."""

from typing import Any

import numpy as np

from starjax.core.types import Array


def lowbias32(x: Array) -> Any:
    """Hashes each number of a uint32 array, of numpy or jax (C. Wellons's `lowbias32`).

    No two numbers have the same hash. Changing one bit of a number changes each bit of its hash
    with a probability of nearly one half.
    """
    x = (x ^ (x >> 16)) * np.uint32(0x7FEB352D)
    x = (x ^ (x >> 15)) * np.uint32(0x846CA68B)
    return x ^ (x >> 16)
