"""Random draws of several disturbances."""

import jax
import jax.numpy as jnp


def directions(key: jax.Array, like: jax.Array) -> jax.Array:
    """Draws unit vectors `[..., 3]`, uniform on the sphere."""
    vectors = jax.random.normal(key, like.shape)
    return vectors / jnp.maximum(jnp.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)
