"""Behaviour cloning without noise: a network predicts a sequence, or several with likelihoods.

With several it is a mixture of normal distributions over whole sequences (Bishop, "Mixture Density
Networks", 1994), all with one spread: its loss with one component is the mean squared error. Ten
ways around an obstacle are then ten components, and a sample is one of them, not their mean.
"""

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from starjax.policies.models import layers


class Mixture(NamedTuple):
    """A distribution of sequences.

    Attributes:
      logits: `[B, M]` of the components' likelihoods.
      means: `[B, M, H, D]`.
    """

    logits: jax.Array
    means: jax.Array


class MixtureNet(nn.Module):
    """A residual MLP from a condition to a mixture.

    Attributes:
      horizon: H.
      action_dim: D.
      components: M.
      width: of the hidden layers.
      blocks: residual blocks.
      dtype: of the arithmetic; parameters, LayerNorm and the output are float32.
    """

    horizon: int
    action_dim: int
    components: int
    width: int
    blocks: int
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, condition: jax.Array) -> Mixture:
        """Returns the mixture for conditions `[B, C]`."""
        x = layers.residual_mlp(condition.astype(self.dtype), self.width, self.blocks, self.dtype)
        size = self.components * self.horizon * self.action_dim
        outputs = layers.Dense(self.components + size, name="out")(x).astype(jnp.float32)
        logits, means = jnp.split(outputs, [self.components], axis=-1)
        shape = (-1, self.components, self.horizon, self.action_dim)
        return Mixture(logits, means.reshape(shape))  # [B, M], [B, M, H, D]


def loss(mixture: Mixture, x0: jax.Array, spread: float) -> jax.Array:
    """Returns the mean negative log likelihood of sequences `[B, H, D]` times 2 spread².

    Without its constant: with one component it is the mean squared error for any spread.

    A sequence counts as one number, since its numbers are far from independent: the exponent has
    their mean squared error, not the sum.

    Args:
      mixture: of each of the B.
      x0: demonstrated sequences.
      spread: standard deviation of a component.
    """
    scale = 2.0 * spread**2
    error = jnp.mean((mixture.means - x0[:, None]) ** 2, axis=(-2, -1))  # [B, M]
    # log sum_m pi_m exp(-error_m / 2 spread^2)
    log_likelihood = jax.nn.logsumexp(jax.nn.log_softmax(mixture.logits) - error / scale, axis=-1)
    return -scale * jnp.mean(log_likelihood)


def draw(mixture: Mixture, keys: jax.Array) -> jax.Array:
    """Returns the mean `[B, H, D]` of a component that is drawn with each of the keys `[B]`."""
    # One component for the whole sequence: modes are not mixed within it.
    chosen = jax.vmap(jax.random.categorical)(keys, mixture.logits)
    return jnp.take_along_axis(mixture.means, chosen[:, None, None, None], axis=1)[:, 0]
