"""Packs parameters for a GPU: vectors (biases, scales) in one array, kernels transposed.

Reference: the parameters as they are; unpacking gives them back. On a GPU an optimiser's kernel
takes longer to start on a vector than to run, and every array that a program is called with costs
the host some microseconds; half of the paper's parameters are vectors. Convolutions read their
kernels, and write the gradients, with the outputs as the first axis: kept that way, neither these
nor what the optimiser knows of them are transposed at every step.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

PLATFORMS = {"gpu"}  # a CPU updates a vector as fast by itself


class Packed(NamedTuple):
    """Packed parameters.

    Attributes:
      matrices: the parameters with None in the vectors' places; of kernels `[h, w, C, F]` the last
        axis is the first.
      vectors: `[n]`, all of them, in the order of jax's leaves.
    """

    matrices: Any
    vectors: jax.Array


class PackedNetwork(struct.PyTreeNode):
    """A network's packed parameters, with what is needed to unpack them.

    Attributes:
      arrays: the parameters.
      shapes: their structure and the shapes of its leaves.
    """

    arrays: Packed
    shapes: tuple[Any, tuple[jax.ShapeDtypeStruct, ...]] = struct.field(pytree_node=False)


def pays(platform: str) -> bool:
    """Returns whether packed parameters are faster on a platform ("cpu", "gpu")."""
    return platform in PLATFORMS


def pack(params: Any, shapes: Any) -> Packed:
    """Packs parameters.

    `shapes` has the same structure and tells vectors from matrices: a matrix may be held flat.
    """
    leaves, tree = jax.tree.flatten(shapes)
    given = tree.flatten_up_to(params)
    matrices = [x if is_matrix(shape) else None for x, shape in zip(given, leaves, strict=True)]
    vectors = [x for x, shape in zip(given, leaves, strict=True) if not is_matrix(shape)]
    return Packed(tree.unflatten(_turned(matrices, -1, 0)), _concatenated(vectors))


def unpack(packed: Packed, shapes: Any) -> Any:
    """Returns the parameters that `pack` was given."""
    leaves, tree = jax.tree.flatten(shapes)
    matrices = _turned(tree.flatten_up_to(packed.matrices), 0, -1)
    vectors = iter(_apart(packed.vectors, tuple(x.shape for x in leaves if not is_matrix(x))))
    given = zip(matrices, leaves, strict=True)
    return tree.unflatten([x if is_matrix(shape) else next(vectors) for x, shape in given])


def pack_all(state: Any, shapes: Any) -> Any:
    """Packs every part of `state` with this structure: parameters, averages, moments."""
    structure = jax.tree.structure(shapes)

    def are_params(x: Any) -> bool:
        return jax.tree.structure(x) == structure

    return jax.tree.map(
        lambda x: pack(x, shapes) if are_params(x) else x, state, is_leaf=are_params
    )


def unpack_all(state: Any, shapes: Any) -> Any:
    """Returns the state that `pack_all` was given."""
    return jax.tree.map(
        lambda x: unpack(x, shapes) if isinstance(x, Packed) else x,
        state,
        is_leaf=lambda x: isinstance(x, Packed),
    )


def packed(params: Any) -> PackedNetwork:
    """Packs a network's parameters, which `applied` takes as it takes others."""
    leaves, tree = jax.tree.flatten(jax.eval_shape(lambda x: x, params))
    return PackedNetwork(pack(params, tree.unflatten(leaves)), (tree, tuple(leaves)))


def applied(apply: Callable[..., Any]) -> Callable[..., Any]:
    """Returns a network's `apply` that also takes a `PackedNetwork`.

    Called within a loop it unpacks the parameters there, in the kernels that use them; before the
    loop a GPU would need one for each.
    """

    def unpacking(params: Any, *given: Any, **options: Any) -> Any:
        if isinstance(params, PackedNetwork):
            tree, leaves = params.shapes
            params = unpack(params.arrays, tree.unflatten(leaves))
        return apply(params, *given, **options)

    return unpacking


def is_matrix(x: Any) -> bool:
    """Returns whether a parameter of this shape stays an array of its own."""
    return x.ndim > 1


def _turned(matrices: list[Any], old: int, new: int) -> list[Any]:
    """Moves axis `old` of convolutions' kernels to `new`; the other matrices stay as they are."""
    moved = iter(_moved([x for x in matrices if _is_kernel(x)], old, new))
    return [next(moved) if _is_kernel(x) else x for x in matrices]


def _is_kernel(x: Any) -> bool:
    return x is not None and x.ndim == 4


# Programs of their own, so that called outside of any they are one, and not one for each array.
@functools.partial(jax.jit, static_argnums=(1, 2))
def _moved(kernels: list[jax.Array], old: int, new: int) -> list[jax.Array]:
    return [jnp.moveaxis(x, old, new) for x in kernels]


@jax.jit
def _concatenated(vectors: list[jax.Array]) -> jax.Array:
    return jnp.concatenate([x.ravel() for x in vectors]) if vectors else jnp.zeros(0)


@functools.partial(jax.jit, static_argnums=1)
def _apart(vectors: jax.Array, shapes: tuple[tuple[int, ...], ...]) -> list[jax.Array]:
    found, first = [], 0
    for shape in shapes:
        size = math.prod(shape)
        found.append(jax.lax.slice_in_dim(vectors, first, first + size).reshape(shape))
        first += size
    return found
