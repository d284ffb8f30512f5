"""Common parts of scripted experts: smooth motion, and a disturbance that they correct."""

import jax
import jax.numpy as jnp

NOISE_STREAM = 1 << 20  # folded into the key: apart from every attempt's stream


def minimum_jerk(share: jax.Array) -> jax.Array:
    """Share of the way `[...]` after a `share` in [0, 1] of the time, at rest at both ends."""
    return share**3 * (10.0 + share * (-15.0 + 6.0 * share))


def disturb(
    key: jax.Array,
    noise: jax.Array,
    step: jax.Array,
    *,
    deviation: jax.Array,
    correlation: float,
    smoothing: float,
    dt: float,
) -> jax.Array:
    """The next value of an Ornstein-Uhlenbeck process and of its low-passed copy.

    Args:
      key: of the episode.
      noise: `[2, n]`, the last rough and smooth values.
      step: int32, the control step.
      deviation: `[n]`, standard deviation of the rough one.
      correlation: s, after which it forgets. smoothing: s, of the low-pass. dt: s.
    """
    keep = jnp.exp(-dt / correlation)
    drawn = jax.random.normal(
        jax.random.fold_in(jax.random.fold_in(key, NOISE_STREAM), step), deviation.shape
    )
    rough = keep * noise[0] + deviation * jnp.sqrt(1.0 - keep**2) * drawn
    smooth = noise[1] + dt / smoothing * (rough - noise[1])
    return jnp.stack([rough, smooth])
