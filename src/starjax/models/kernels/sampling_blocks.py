"""The U-Net's blocks as a GPU samples with them: the same functions in fewer kernels.

Of one robot's action, and of hundreds, what takes a GPU longest after the products themselves is
the way from one product to the next: adding up the taps, GroupNorm, Mish, FiLM and the skip. Here
that is two kernels. The products are shifted, not the inputs, and the skip's 1x1 convolution is
part of the first one; then each group of a sample lies in one row, because XLA makes one kernel of
what follows the sums over rows (not over other axes), up to the next product.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from starjax.models import layers
from starjax.models.kernels import norms

Params = Mapping[str, Any]


def prepared(params: Params) -> dict[str, Any]:
    """The U-Net's parameters with those of its blocks as the functions below take them."""
    if "ConvBlock_0" in params:
        return {
            "first": _conv_block(params["ConvBlock_0"], params.get("Conv1d_0")),
            "second": _conv_block(params["ConvBlock_1"]),
        }
    if "GroupNorm_0" in params:
        return _conv_block(params)
    return {
        name: prepared(child) if isinstance(child, dict) else child
        for name, child in params.items()
    }


def residual_block(params: Params, x: jax.Array, film: jax.Array, groups: int) -> jax.Array:
    """`unet1d.ResidualBlock`: `[B, L, C]`, `[B, 2 features]` -> `[B, L, features]`."""
    scale, bias = (_by_groups(part, groups) for part in jnp.split(film[:, None, :], 2, axis=-1))
    h, skip = _normalized(params["first"], x, groups)
    h, _ = _normalized(params["second"], _flat(scale * h + bias), groups)
    h = _flat(h + _by_groups(x if skip is None else skip, groups))
    # without a barrier XLA turns the sum only after it is written, in a kernel of its own
    return jax.lax.optimization_barrier(h)


def conv_block(params: Params, x: jax.Array, groups: int) -> jax.Array:
    """`unet1d.ConvBlock`: `[B, L, C] -> [B, L, features]`."""
    return _flat(_normalized(params, x, groups)[0])


def _conv_block(block: Params, beside: Params | None = None) -> dict[str, Any]:
    """A ConvBlock's parameters, and a 1x1 convolution's that is to be computed beside it.

    `kernel` `[taps features + more, C]`: a product with it gives every tap's, then the other's.
    """
    convolutions = [block["Conv1d_0"]] if beside is None else [block["Conv1d_0"], beside]
    turned = [jnp.moveaxis(conv["kernel"], 1, 2) for conv in convolutions]
    return {
        "kernel": jnp.concatenate([kernel.reshape(-1, kernel.shape[-1]) for kernel in turned]),
        "bias": jnp.concatenate([conv["bias"] for conv in convolutions]),
        "gain": block["GroupNorm_0"]["scale"],
        "shift": block["GroupNorm_0"]["bias"],
    }


def _normalized(params: Params, x: jax.Array, groups: int) -> tuple[jax.Array, jax.Array | None]:
    """Mish of the normalised convolution, `[B, L, groups, features / groups]`, and what is computed
    beside it, `[B, L, more]`."""
    kernel, bias = params["kernel"], params["bias"]
    features = len(params["gain"])
    more = len(bias) - features
    products = jax.lax.dot_general(x, kernel.astype(x.dtype), (((2,), (1,)), ((), ())))
    taps, beside = jnp.split(products, [len(kernel) - more], axis=-1)
    rows = _by_groups(_shifted_sum(taps, bias[:features]), groups).swapaxes(1, 2)
    # without a barrier XLA does not see that these are rows
    flat = jax.lax.optimization_barrier(rows.reshape(len(x) * groups, -1)).astype(jnp.float32)
    centred = flat - flat.mean(-1, keepdims=True)
    variance = (centred * centred).mean(-1, keepdims=True)
    y = (centred * jax.lax.rsqrt(variance + norms.EPSILON)).reshape(rows.shape)
    y = y * _per_group(params["gain"], groups) + _per_group(params["shift"], groups)
    y = layers.mish(y).astype(x.dtype).swapaxes(1, 2)
    return y, beside + bias[features:].astype(x.dtype) if more else None


def _shifted_sum(products: jax.Array, bias: jax.Array) -> jax.Array:
    """`[B, L, taps features]` of every tap with every input -> `[B, L, features]`."""
    batch, length, width = products.shape
    taps = width // len(bias)
    of_tap = products.reshape(batch, length, taps, -1)
    total = bias.astype(jnp.float32)
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
    """`[features]` beside rows `[B, groups, L, features / groups]`."""
    return vector.reshape(groups, 1, -1)
