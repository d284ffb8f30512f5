"""Action chunking with transformers: a conditional variational autoencoder of sequences.

Zhao et al., "Learning Fine-Grained Bimanual Manipulation with Low-Cost Hardware" (RSS 2023). In
training an encoder maps the demonstrated sequence to its style z; at inference z is 0, the mean of
its prior. A decoder turns z and the observation into the sequence.

Differences: layers are normalised before attention, not after it, and have no dropout; an
image is one token, the output of the encoder that all learners share, not one token per cell.
"""

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from starjax.policies.models import layers

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
    # reparametrisation: z = mu + sigma * noise
    return style.mean + jnp.exp(0.5 * style.log_variance) * noise


def divergence(style: Style) -> jax.Array:
    """Returns the mean Kullback-Leibler divergence from the standard normal, summed over z."""
    # KL(N(mu, sigma^2) || N(0, 1)) = (sigma^2 + mu^2 - 1 - log sigma^2) / 2 per entry
    each = jnp.exp(style.log_variance) + style.mean**2 - 1.0 - style.log_variance
    return jnp.mean(0.5 * jnp.sum(each, axis=-1))


class Layer(nn.Module):
    """A transformer layer: self-attention, cross-attention if `others` are passed, and an MLP.

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
        x = x + self._attention("attend_itself")(h, h)  # pre-norm: the residual path stays linear
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
    """Encoder of a demonstrated sequence, used in training only.

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
        """Returns the style of sequences `[B, H, D]`, observed with `state` `[B, S]`."""
        actions = layers.Dense(self.width, name="actions")(x0.astype(self.dtype))
        now = layers.Dense(self.width, name="state")(state.astype(self.dtype))[:, None]
        first = self.param("first", _start, (1, self.width)).astype(self.dtype)  # [CLS]: reads all
        x = jnp.concatenate([jnp.broadcast_to(first, now.shape), now, actions], axis=1)
        # Attention is blind to the order of tokens.
        x = _placed(self, x)
        for _ in range(self.layers):
            x = Layer(self.heads, self.mlp, self.dtype)(x)
        # mu, log s^2
        outputs = layers.Dense(2 * self.features, name="out")(x[:, 0].astype(jnp.float32))
        return Style(*jnp.split(outputs, 2, axis=-1))


class Decoder(nn.Module):
    """Decoder of a style and an observation to a sequence.

    Attributes:
      horizon: H.
      action_dim: D.
      width: of all tokens.
      heads, mlp, dtype: of the layers, see `Layer`.
      encoder_layers: layers in which the tokens of the observation attend to each other.
      decoder_layers: layers in which the tokens of actions attend to each other and to those.
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
        self, z: jax.Array, vision: jax.Array | None, state: jax.Array, trocar: jax.Array
    ) -> jax.Array:
        """Returns float32 `[B, H, D]`.

        Args:
          z: `[B, Z]`.
          vision: `[B, O, V]`, one token per observation, or None.
          state: `[B, S]`.
          trocar: `[B, E]` features of the trocar; E may be 0.
        """
        parts = {"style": z[:, None], "state": state[:, None], "vision": vision}
        if trocar.shape[-1]:
            parts["told"] = trocar[:, None]  # the parameters' name
        tokens = jnp.concatenate(
            [
                layers.Dense(self.width, name=name)(part.astype(self.dtype))
                for name, part in parts.items()
                if part is not None
            ],
            axis=1,
        )
        tokens = _placed(self, tokens)
        for _ in range(self.encoder_layers):
            tokens = Layer(self.heads, self.mlp, self.dtype)(tokens)
        # One learned query a future step: all H actions come out at once, without a causal mask.
        queries = self.param("queries", _start, (self.horizon, self.width)).astype(self.dtype)
        x = jnp.broadcast_to(queries, (len(z), *queries.shape))
        for _ in range(self.decoder_layers):
            x = Layer(self.heads, self.mlp, self.dtype)(x, tokens)  # queries attend to observations
        x = nn.LayerNorm()(x.astype(jnp.float32))
        return layers.Dense(self.action_dim, name="out")(x)


def _placed(module: nn.Module, x: jax.Array) -> jax.Array:
    """Adds learned positions, parameters of the calling module, to tokens `[B, L, C]`."""
    positions = module.param("positions", _start, x.shape[1:])
    return x + positions.astype(x.dtype)


def _start(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Draws small random numbers, learned tokens before training."""
    return layers.uniform_init(1, START)(key, shape)
