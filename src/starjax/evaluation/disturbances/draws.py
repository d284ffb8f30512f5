"""Random draws of several disturbances."""

import jax
import jax.numpy as jnp


def directions(key: jax.Array, like: jax.Array) -> jax.Array:
    """Unit vectors `[..., 3]`, uniform on the sphere."""
    drawn = jax.random.normal(key, like.shape)
    return drawn / jnp.maximum(jnp.linalg.norm(drawn, axis=-1, keepdims=True), 1e-9)
