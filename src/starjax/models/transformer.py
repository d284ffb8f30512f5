"""Action chunking with transformers: a conditional variational autoencoder of sequences.

Zhao et al., "Learning Fine-Grained Bimanual Manipulation with Low-Cost Hardware" (RSS 2023). In
training an encoder reads the demonstrated sequence and says its style z; at inference z is 0, the
mean of what it may be. A decoder turns z and the observation into the sequence.

Other than there: layers are normalised before attention, not after it, and have no dropout; an
image is one token, what the encoder of all learners makes of it, and not one token a cell.
"""

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from starjax.models import layers

START = 0.02  # learned tokens and positions are within +- this before training


class Style(NamedTuple):
    """A normal distribution of z.

    Attributes:
      mean: `[B, Z]`.
      log_variance: `[B, Z]`.
    """

    mean: jax.Array
    log_variance: jax.Array


def drawn(style: Style, noise: jax.Array) -> jax.Array:
    """Returns z `[B, Z]` of standard normal noise `[B, Z]`."""
    return style.mean + jnp.exp(0.5 * style.log_variance) * noise


def divergence(style: Style) -> jax.Array:
    """Returns the mean Kullback-Leibler divergence from the standard normal, summed over z."""
    each = jnp.exp(style.log_variance) + style.mean**2 - 1.0 - style.log_variance
    return jnp.mean(0.5 * jnp.sum(each, axis=-1))


class Layer(nn.Module):
    """One layer of a transformer: attention to itself, to others if they are given, and an MLP.

    Attributes:
      heads: of the attention; divides the width.
      mlp: width of the MLP.
      dtype: of the arithmetic; parameters and LayerNorm are float32.
    """

    heads: int
    mlp: int
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, x: jax.Array, others: jax.Array | None = None) -> jax.Array:
        """Maps `[B, L, C] -> [B, L, C]`, in `dtype`; `others` `[B, N, C]`."""
        h = self._normalised(x)
        x = x + self._attention("attend_itself")(h, h)
        if others is not None:
            x = x + self._attention("attend_others")(self._normalised(x), others)
        h = nn.relu(layers.Dense(self.mlp, name="widen")(self._normalised(x)))
        return x + layers.Dense(x.shape[-1], name="narrow")(h)

    def _normalised(self, x: jax.Array) -> jax.Array:
        return nn.LayerNorm()(x.astype(jnp.float32)).astype(self.dtype)

    def _attention(self, name: str) -> nn.MultiHeadDotProductAttention:
        return nn.MultiHeadDotProductAttention(
            self.heads, dtype=self.dtype, kernel_init=layers.xavier_init, name=name
        )


class StyleEncoder(nn.Module):
    """Reads a demonstrated sequence. Only training has it.

    Attributes:
      features: Z.
      width: of all tokens.
      heads, mlp, dtype: of the layers, see `Layer`.
      layers: number of layers.
    """

    features: int
    width: int
    heads: int
    mlp: int
    layers: int
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, x0: jax.Array, state: jax.Array) -> Style:
        """Returns the style of sequences `[B, H, D]`, seen in `state` `[B, S]`."""
        actions = layers.Dense(self.width, name="actions")(x0.astype(self.dtype))
        now = layers.Dense(self.width, name="state")(state.astype(self.dtype))[:, None]
        first = self.param("first", _start, (1, self.width)).astype(self.dtype)
        x = jnp.concatenate([jnp.broadcast_to(first, now.shape), now, actions], axis=1)
        x = _placed(self, x)
        for _ in range(self.layers):
            x = Layer(self.heads, self.mlp, self.dtype)(x)
        said = layers.Dense(2 * self.features, name="out")(x[:, 0].astype(jnp.float32))
        return Style(*jnp.split(said, 2, axis=-1))


class Decoder(nn.Module):
    """Turns a style and an observation into a sequence.

    Attributes:
      horizon: H.
      action_dim: D.
      width: of all tokens.
      heads, mlp, dtype: of the layers, see `Layer`.
      encoder_layers: in which the tokens of what is observed attend to each other.
      decoder_layers: in which those of the actions attend to each other and to them.
    """

    horizon: int
    action_dim: int
    width: int
    heads: int
    mlp: int
    encoder_layers: int
    decoder_layers: int
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(
        self, z: jax.Array, vision: jax.Array | None, state: jax.Array, told: jax.Array
    ) -> jax.Array:
        """Returns float32 `[B, H, D]`.

        Args:
          z: `[B, Z]`.
          vision: `[B, O, V]`, one token a moment, or None.
          state: `[B, S]`.
          told: `[B, E]`; E may be 0.
        """
        parts = {"style": z[:, None], "state": state[:, None], "vision": vision}
        if told.shape[-1]:
            parts["told"] = told[:, None]
        seen = jnp.concatenate(
            [
                layers.Dense(self.width, name=name)(part.astype(self.dtype))
                for name, part in parts.items()
                if part is not None
            ],
            axis=1,
        )
        seen = _placed(self, seen)
        for _ in range(self.encoder_layers):
            seen = Layer(self.heads, self.mlp, self.dtype)(seen)
        queries = self.param("queries", _start, (self.horizon, self.width)).astype(self.dtype)
        x = jnp.broadcast_to(queries, (len(z), *queries.shape))
        for _ in range(self.decoder_layers):
            x = Layer(self.heads, self.mlp, self.dtype)(x, seen)
        x = nn.LayerNorm()(x.astype(jnp.float32))
        return layers.Dense(self.action_dim, name="out")(x)


def _placed(module: nn.Module, x: jax.Array) -> jax.Array:
    """Adds learned positions, parameters of the calling module, to tokens `[B, L, C]`."""
    positions = module.param("positions", _start, x.shape[1:])
    return x + positions.astype(x.dtype)


def _start(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Draws small random numbers, learned tokens before training."""
    return layers.uniform_init(1, START)(key, shape)
