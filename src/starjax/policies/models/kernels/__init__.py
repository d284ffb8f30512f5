"""Variants of parts of the networks that are faster on one kind of device.

One file holds one variant. Its first lines name the reference that it equals, and its function
`pays` decides from the device and the shapes if it is used; tests/policies/models/kernels compares
the two.
`choose` is the only door: to drop a variant, delete its file and its line of `VARIANTS`. Add-ons
bring others, as parts of the kind `variant`.
"""

import importlib
from collections.abc import Callable
from typing import Any, Protocol, TypeVar, runtime_checkable

import jax
from flax import linen as nn

from starjax.core import extensions
from starjax.core.types import ArrayTree

Reference = TypeVar("Reference")

# part of a network: "module:name" of its variant  # use
VARIANTS = {
    "sum_of_positions": f"{__name__}.channel_sums:in_two_steps",  # biases' gradients; on a GPU
    "pack": f"{__name__}.packed_params:pack",  # vectors in one array; on a GPU
    "NormReluPool": f"{__name__}.pooled_norm:PooledNorm",  # one gradient for all three; everywhere
    **extensions.parts("variant"),
}


@runtime_checkable
class RewrittenParams(Protocol):
    """Parameters in another form, a pytree node."""

    def resolve(self, module: nn.Module) -> tuple[Any, Any]:
        """Returns the module to apply, in place of `module`, and the parameters that it takes."""
        ...


def choose(part: str, reference: Reference, *size: Any) -> Reference:
    """Returns the variant of a part that is faster here, else the reference.

    Args:
      part: name of the part.
      reference: function or module, used if there is no variant or it does not pay.
      *size: arguments of the variant's `pays`.
    """
    if part not in VARIANTS:
        return reference
    module, name = VARIANTS[part].split(":")
    variant = importlib.import_module(module)
    return getattr(variant, name) if variant.pays(*size) else reference


def packed(tree: ArrayTree, params: ArrayTree | None = None, platform: str | None = None) -> Any:
    """Returns `tree` with its parts of the structure of `params` in fewer arrays, if faster.

    Args:
      tree: parameters, or a state with parameters, averages and moments.
      params: parameters or their shapes; None: `tree`.
      platform: "cpu" or "gpu"; None: jax's default.
    """
    pack = choose("pack", lambda tree, params: tree, platform or jax.default_backend())
    return pack(tree, tree if params is None else params)


def unpacked(tree: ArrayTree) -> Any:
    """Returns the tree that `packed` was called with."""
    is_packed = lambda x: isinstance(x, RewrittenParams)  # noqa: E731
    return jax.tree.map(
        lambda x: x.resolve(None)[1] if is_packed(x) else x, tree, is_leaf=is_packed
    )


def fused_unet(params: ArrayTree) -> Any:
    """Returns the parameters of a `ConditionalUnet1D` in the form fastest to sample with."""
    return choose("fuse_unet", lambda params: params)(params)


def applied(module: nn.Module) -> Callable[..., Any]:
    """Returns a network's `apply` that also takes rewritten parameters.

    Called within a loop it unpacks parameters there, in the kernels that use them; before the loop
    a GPU would need one more kernel per parameter.
    """

    def apply(params: Any, *args: Any, **options: Any) -> Any:
        network = module
        while isinstance(params, RewrittenParams):
            network, params = params.resolve(network)
        return network.apply(params, *args, **options)

    return apply


def on_gpu() -> bool:
    """Returns whether programs are traced for a GPU.

    `jax.lax.platform_dependent` would trace both branches, and differentiate both.
    """
    return jax.default_backend() == "gpu"
