"""Diffusion Policy's conditional U-Net over the time axis of an action sequence.

n levels give n - 1 halvings (16 -> 8 -> 4 -> 2); the condition enters every residual block as
FiLM, `scale * h + bias` after its first convolution.

FiLM is one affine map of Mish([time embedding, condition]) for all blocks together. Mish acts on
each entry, so the map splits exactly into a part of the time and a part of the condition: the
latter is computed once for all DDIM steps:

    film_cond = unet.apply(params, cond, method="condition")
    prepare = lambda k: unet.apply(params, k, method="embed_step")
    eps_fn = lambda x, film_k: unet.apply(params, x, film_cond + film_k, method="denoise")
    diffusion.ddim_sample(eps_fn, noise, prepare=prepare)
"""

import itertools
import math
from collections.abc import Callable

import flax.linen as nn
import jax
import jax.numpy as jnp

from starjax.policies.models import layers
from starjax.policies.models.group_norm import GroupNorm


class ResidualBlock(nn.Module):
    """Two convolution blocks with FiLM between them, and a skip (1x1 where the width changes)."""

    features: int
    kernel_size: int
    groups: int

    @nn.compact
    def __call__(self, x: jax.Array, film: jax.Array) -> jax.Array:
        """Maps `x` `[B, L, C]`, `film` `[B, 2 features]` (scale, bias) -> `[B, L, features]`."""
        # [B, 1, features]: same for all steps
        scale, bias = jnp.split(film[:, None, :], 2, axis=-1)
        h = ConvBlock(self.features, self.kernel_size, self.groups)(x)
        h = ConvBlock(self.features, self.kernel_size, self.groups)(scale * h + bias)  # FiLM
        skip = x if x.shape[-1] == self.features else layers.Conv1d(self.features, 1)(x)
        return h + skip


class ConvBlock(nn.Module):
    """Conv1d, GroupNorm, Mish."""

    features: int
    kernel_size: int
    groups: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps `[B, L, C] -> [B, L, features]`."""
        x = layers.Conv1d(self.features, self.kernel_size)(x)
        return layers.mish(GroupNorm(self.groups)(x))


class ConditionalUnet1D(nn.Module):
    """Predicts the noise in `[B, H, A]`; H must be divisible by 2 ** (levels - 1).

    Attributes:
      action_dim: A.
      cond_dim: width C of the condition.
      channels: of each level, all divisible by `groups`.
      kernel_size: of the residual blocks' convolutions; odd.
      groups: of GroupNorm.
      time_dim: width of the sinusoidal embedding of the diffusion step; even.
      dtype: of the arithmetic; parameters, statistics and the output are float32.
      residual_block: module of the blocks, called as `ResidualBlock`.
      conv_block: module of the last convolution, called as `ConvBlock`.
    """

    action_dim: int
    cond_dim: int
    channels: tuple[int, ...] = (256, 512, 1024, 2048)
    kernel_size: int = 5
    groups: int = 8
    time_dim: int = 128
    dtype: jnp.dtype = jnp.float32
    residual_block: Callable[..., nn.Module] = ResidualBlock
    conv_block: Callable[..., nn.Module] = ConvBlock

    def setup(self):
        widths = self.channels
        upward = tuple(reversed(widths[:-1]))
        self.down = [[self._block(c), self._block(c)] for c in widths]
        self.halve = [layers.Conv1d(c, 3, stride=2) for c in widths[:-1]]
        self.middle = [self._block(widths[-1]), self._block(widths[-1])]
        self.up = [[self._block(c), self._block(c)] for c in upward]
        self.double = [layers.Upsample1d() for _ in upward]
        self.last = self.conv_block(widths[0], self.kernel_size, self.groups)
        self.out = layers.Conv1d(self.action_dim, 1)

        self.time_in = layers.Dense(4 * self.time_dim)
        self.time_out = layers.Dense(self.time_dim)
        # Two blocks a level
        self.film_widths = [c for c in (*widths, widths[-1], *upward) for _ in range(2)]
        size = 2 * sum(self.film_widths)  # scale and bias of every channel
        init = layers.uniform_init(self.time_dim + self.cond_dim)
        self.film_time = self.param("film_time", init, (self.time_dim, size))
        self.film_cond = self.param("film_cond", init, (self.cond_dim, size))
        self.film_bias = self.param("film_bias", init, (size,))

    def __call__(self, x: jax.Array, k: jax.Array, cond: jax.Array) -> jax.Array:
        """Predicts the noise in `x` `[B, H, A]` at `k` (int `[B]` or `[]`) given `cond`."""
        k = jnp.broadcast_to(k, x.shape[:1])
        return self.denoise(x, self.condition(cond) + self.embed_step(k))

    def condition(self, cond: jax.Array) -> jax.Array:
        """Returns the condition's part of every FiLM: `[B, C] -> float32 [B, F]`."""
        if cond.shape[-1] != self.cond_dim:
            raise ValueError(f"cond: expected [B, {self.cond_dim}], got {cond.shape}")
        # Mish acts entry by entry, so the part of the condition splits off (module docstring).
        active = layers.mish(cond.astype(self.dtype))
        film = _matmul_f32(active, self.film_cond)
        return film + layers.spread(self.film_bias, film.shape)

    def embed_step(self, k: jax.Array) -> jax.Array:
        """Returns the diffusion step's part of every FiLM: int `[...] -> float32 [..., F]`."""
        half = self.time_dim // 2
        fall = -math.log(10_000.0) / max(half - 1, 1)
        frequency = jnp.exp(jnp.arange(half, dtype=jnp.float32) * fall)  # 1 .. 1e-4, geometric
        angle = jnp.asarray(k, jnp.float32)[..., None] * frequency.reshape(
            (1,) * jnp.ndim(k) + (-1,)
        )
        # [.., time_dim]
        wave = jnp.concatenate([jnp.sin(angle), jnp.cos(angle)], -1).astype(self.dtype)
        embedding = self.time_out(layers.mish(self.time_in(wave)))
        return _matmul_f32(layers.mish(embedding), self.film_time)

    def denoise(self, x: jax.Array, film: jax.Array) -> jax.Array:
        """Predicts the noise in `x` `[B, H, A]`, float32, given the summed FiLM `[B, F]`."""
        factor = 2 ** (len(self.channels) - 1)
        if x.ndim != 3 or x.shape[1] % factor or x.shape[2] != self.action_dim:
            raise ValueError(
                f"x: expected [B, H, {self.action_dim}] with H divisible by {factor}, got {x.shape}"
            )
        ends = itertools.accumulate(2 * c for c in self.film_widths[:-1])
        films = iter(jnp.split(film.astype(self.dtype), list(ends), axis=-1))
        x = x.astype(self.dtype)
        skips = []
        for level, (first, second) in enumerate(self.down):
            x = second(first(x, next(films)), next(films))
            # Kept at every level: the upward half gets back the detail that halving loses.
            skips.append(x)
            if level < len(self.halve):
                x = self.halve[level](x)
        for block in self.middle:
            x = block(x, next(films))
        for (first, second), double in zip(self.up, self.double, strict=True):
            x = jnp.concatenate([x, skips.pop()], -1)  # [B, L, 2 C]
            x = double(second(first(x, next(films)), next(films)))
        return self.out(self.last(x)).astype(jnp.float32)  # eps or v, in the unit of x

    def _block(self, features: int) -> nn.Module:
        return self.residual_block(features, self.kernel_size, self.groups)


@jax.custom_vjp
def _matmul_f32(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """Multiplies in the dtype of `x`; accumulates and returns float32.

    The two FiLM parts are added before they are rounded. So is their gradient, which is therefore
    exact in that dtype.
    """
    return jnp.matmul(x, kernel.astype(x.dtype), preferred_element_type=jnp.float32)


def _matmul_f32_gradient(
    kept: tuple[jax.Array, jax.Array], g: jax.Array
) -> tuple[jax.Array, jax.Array]:
    x, kernel = kept
    g = g.astype(x.dtype)
    return g @ kernel.astype(x.dtype).T, (x.T @ g).astype(kernel.dtype)


_matmul_f32.defvjp(lambda x, kernel: (_matmul_f32(x, kernel), (x, kernel)), _matmul_f32_gradient)
