"""A U-Net for sampling, whose blocks are the same functions in fewer kernels.

Reference: `unet1d.ResidualBlock` and `unet1d.ConvBlock`. What takes a GPU longest after the matrix
products is the way from one to the next: adding up the taps, GroupNorm, Mish, FiLM and the skip.
Here that is two kernels. The products are shifted, not the inputs, and the skip's 1x1 convolution
is part of the first product. Then each group of a sample lies in one row, because XLA fuses
sums over rows (not over other axes) with all operations up to the next product.
"""

from collections.abc import Mapping
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct

from starjax.policies.models import group_norm, kernels, layers
from starjax.policies.models.unet1d import ConditionalUnet1D

Params = Mapping[str, Any]


class PreparedUnet(struct.PyTreeNode):
    """A U-Net's parameters as the blocks below take them."""

    params: Any

    def resolve(self, module: ConditionalUnet1D) -> tuple[ConditionalUnet1D, Any]:
        """Returns the U-Net with the blocks below, and its parameters."""
        module = module.clone(residual_block=SamplingBlock, conv_block=SamplingConv)
        return module, self.params


def pays() -> bool:
    """Returns whether the blocks below are faster here; on a CPU they are slower."""
    return kernels.on_gpu()


def prepared(params: Params) -> PreparedUnet:
    """Rewrites the parameters of a `ConditionalUnet1D`."""
    return PreparedUnet(_prepared(params))


class SamplingBlock(nn.Module):
    """`unet1d.ResidualBlock` of prepared parameters."""

    features: int
    kernel_size: int
    groups: int

    @nn.compact
    def __call__(self, x: jax.Array, film: jax.Array) -> jax.Array:
        """Maps `[B, L, C]`, `[B, 2 features]` -> `[B, L, features]`."""
        first, second = (self.get_variable("params", name) for name in ("first", "second"))
        parts = jnp.split(film[:, None, :], 2, axis=-1)
        scale, bias = (_by_groups(part, self.groups) for part in parts)
        h, skip = _normalized(first, x, self.groups)
        h, _ = _normalized(second, _flat(scale * h + bias), self.groups)
        h = _flat(h + _by_groups(x if skip is None else skip, self.groups))
        # Without the barrier XLA transposes the sum only after writing it, in a kernel of its own.
        return jax.lax.optimization_barrier(h)


class SamplingConv(nn.Module):
    """`unet1d.ConvBlock` of prepared parameters."""

    features: int
    kernel_size: int
    groups: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps `[B, L, C] -> [B, L, features]`."""
        return _flat(_normalized(self.variables["params"], x, self.groups)[0])


def _prepared(params: Params) -> dict[str, Any]:
    if "ConvBlock_0" in params:
        return {
            "first": _conv_block(params["ConvBlock_0"], params.get("Conv1d_0")),
            "second": _conv_block(params["ConvBlock_1"]),
        }
    if "GroupNorm_0" in params:
        return _conv_block(params)
    return {
        name: _prepared(child) if isinstance(child, dict) else child
        for name, child in params.items()
    }


def _conv_block(block: Params, skip: Params | None = None) -> dict[str, Any]:
    """Rewrites a ConvBlock's parameters, together with those of a skip's 1x1 convolution.

    `kernel` `[taps features + more, C]`: one product with it gives every tap's, then the skip's.
    """
    convolutions = [block["Conv1d_0"]] if skip is None else [block["Conv1d_0"], skip]
    turned = [jnp.moveaxis(conv["kernel"], 1, 2) for conv in convolutions]
    return {
        "kernel": jnp.concatenate([kernel.reshape(-1, kernel.shape[-1]) for kernel in turned]),
        "bias": jnp.concatenate([conv["bias"] for conv in convolutions]),
        "gain": block["GroupNorm_0"]["scale"],
        "shift": block["GroupNorm_0"]["bias"],
    }


def _normalized(params: Params, x: jax.Array, groups: int) -> tuple[jax.Array, jax.Array | None]:
    """Returns Mish of the normalised convolution, and the skip.

    The first is `[B, L, groups, features / groups]`, the skip `[B, L, more]`; None without one.
    """
    kernel, bias = params["kernel"], params["bias"]
    features = len(params["gain"])
    more = len(bias) - features
    products = jax.lax.dot_general(x, kernel.astype(x.dtype), (((2,), (1,)), ((), ())))
    taps, skip = jnp.split(products, [len(kernel) - more], axis=-1)
    rows = _by_groups(_shifted_sum(taps, bias[:features]), groups).swapaxes(1, 2)
    # Without the barrier XLA does not see that these are rows.
    flat = jax.lax.optimization_barrier(rows.reshape(len(x) * groups, -1)).astype(jnp.float32)
    centred = flat - flat.mean(-1, keepdims=True)
    variance = (centred * centred).mean(-1, keepdims=True)
    y = (centred * jax.lax.rsqrt(variance + group_norm.EPSILON)).reshape(rows.shape)
    y = y * _per_group(params["gain"], groups) + _per_group(params["shift"], groups)
    y = layers.mish(y).astype(x.dtype).swapaxes(1, 2)
    return y, skip + bias[None, None, features:].astype(x.dtype) if more else None


def _shifted_sum(products: jax.Array, bias: jax.Array) -> jax.Array:
    """Adds up every tap's products `[B, L, taps features]`, shifted: `[B, L, features]`."""
    batch, length, width = products.shape
    taps = width // len(bias)
    of_tap = products.reshape(batch, length, taps, -1)
    total = jnp.broadcast_to(bias.astype(jnp.float32), (batch, length, len(bias)))
    for tap in range(taps):
        ahead = tap - taps // 2  # output i takes input i + ahead
        part = of_tap[:, max(0, ahead) : length + min(0, ahead), tap].astype(jnp.float32)
        total = total + jnp.pad(part, ((0, 0), (max(0, -ahead), max(0, ahead)), (0, 0)))
    return total.astype(products.dtype)


def _by_groups(x: jax.Array, groups: int) -> jax.Array:
    return x.reshape(*x.shape[:-1], groups, -1)


def _flat(x: jax.Array) -> jax.Array:
    return x.reshape(*x.shape[:-2], -1)


def _per_group(vector: jax.Array, groups: int) -> jax.Array:
    """Returns `[features]` for rows `[B, groups, L, features / groups]`."""
    return vector.reshape(1, groups, 1, -1)
