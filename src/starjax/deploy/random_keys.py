"""Checks of random keys that callers give."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from starjax.core import errors


def check(key: Any) -> None:
    """Raises UsageError unless `key` is one random key."""
    if not isinstance(key, jax.Array | np.ndarray):
        got = type(key).__name__
    elif not _is_key(key):
        got = f"{key.dtype}{list(key.shape)}"
    else:
        return
    raise errors.UsageError("key", "one jax.random.key for all robots", got)


def _is_key(array: jax.Array | np.ndarray) -> bool:
    """Returns True for one key, typed or in jax's older form."""
    if jnp.issubdtype(array.dtype, jax.dtypes.prng_key):
        return array.ndim == 0
    old = jax.eval_shape(lambda: jax.random.key_data(jax.random.key(0)))
    return (array.dtype, array.shape) == (old.dtype, old.shape)
