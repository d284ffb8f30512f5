"""A hash of numbers, where jax's own would take too long to draw or to compile."""

from typing import Any

import numpy as np


def lowbias32(x: Any) -> Any:
    """A hash of uint32 arrays (of C. Wellons), one to one: each bit flips half of the result's."""
    x = (x ^ (x >> 16)) * np.uint32(0x7FEB352D)
    x = (x ^ (x >> 15)) * np.uint32(0x846CA68B)
    return x ^ (x >> 16)
