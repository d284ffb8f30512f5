"""Packs parameters for a GPU: vectors (biases, scales) in one array, kernels transposed.

Reference: the parameters as they are; unpacking gives them back. On a GPU an optimiser's kernel
takes longer to start on a vector than to run, and every array that a program is called with costs
the host some microseconds; half of the paper's parameters are vectors. Convolutions read their
kernels, and write the gradients, with the outputs as the first axis: kept that way, neither these
nor the optimiser's moments are transposed at every step.
"""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn
from flax import struct

from starjax.core.types import ArrayTree

PLATFORMS = {"gpu"}  # a CPU updates a vector as fast by itself


class Packed(struct.PyTreeNode):
    """Packed parameters.

    Attributes:
      matrices: the parameters, with None in place of vectors; kernels `[h, w, C, F]` have their
        last axis first.
      vectors: `[n]`, all of them, in the order of jax's leaves.
      shapes: structure of the parameters, and the shape of each leaf.
    """

    matrices: Any
    vectors: jax.Array
    shapes: tuple[Any, tuple[tuple[int, ...], ...]] = struct.field(pytree_node=False)

    def resolve(self, module: nn.Module) -> tuple[Any, Any]:
        """Returns `module` and the parameters that were packed."""
        tree, shapes = self.shapes
        matrices = _turned(tree.flatten_up_to(self.matrices), 0, -1)
        vectors = iter(_split(self.vectors, tuple(x for x in shapes if not is_matrix(x))))
        pairs = zip(matrices, shapes, strict=True)
        return module, tree.unflatten([x if is_matrix(s) else next(vectors) for x, s in pairs])


def pays(platform: str) -> bool:
    """Returns whether packed parameters are faster on a platform ("cpu", "gpu")."""
    return platform in PLATFORMS


def pack(state: ArrayTree, params: ArrayTree) -> Any:
    """Packs every part of `state` with the structure of `params`: parameters, averages, moments.

    `params`, or their shapes, tell vectors from matrices: `state` may hold a matrix flat.
    """
    leaves, structure = jax.tree.flatten(params)
    shapes = tuple(x.shape for x in leaves)

    def are_params(x: Any) -> bool:
        return jax.tree.structure(x) == structure

    def packed(params: ArrayTree) -> Packed:
        pairs = list(zip(structure.flatten_up_to(params), shapes, strict=True))
        matrices = _turned([x if is_matrix(shape) else None for x, shape in pairs], -1, 0)
        vectors = _concatenated([x for x, shape in pairs if not is_matrix(shape)])
        return Packed(structure.unflatten(matrices), vectors, _same(structure, shapes))

    return jax.tree.map(lambda x: packed(x) if are_params(x) else x, state, is_leaf=are_params)


def is_matrix(shape: tuple[int, ...]) -> bool:
    """Returns whether a parameter of this shape stays an array of its own."""
    return len(shape) > 1


@functools.cache
def _same(
    structure: jax.tree_util.PyTreeDef, shapes: tuple[tuple[int, ...], ...]
) -> tuple[Any, Any]:
    """Returns one object for equal arguments: every call of a program compares them."""
    return structure, shapes


def _turned(matrices: list[Any], old: int, new: int) -> list[Any]:
    """Moves axis `old` of convolutions' kernels to `new`; the other matrices stay as they are."""
    moved = iter(_moved([x for x in matrices if _is_kernel(x)], old, new))
    return [next(moved) if _is_kernel(x) else x for x in matrices]


def _is_kernel(x: Any) -> bool:
    return x is not None and x.ndim == 4


# Jitted: called outside of a program, each is one program and not one for every array.
@functools.partial(jax.jit, static_argnums=(1, 2))
def _moved(kernels: list[jax.Array], old: int, new: int) -> list[jax.Array]:
    return [jnp.moveaxis(x, old, new) for x in kernels]


@jax.jit
def _concatenated(vectors: list[jax.Array]) -> jax.Array:
    return jnp.concatenate([x.ravel() for x in vectors]) if vectors else jnp.zeros(0)


@functools.partial(jax.jit, static_argnums=1)
def _split(vectors: jax.Array, shapes: tuple[tuple[int, ...], ...]) -> list[jax.Array]:
    parts, first = [], 0
    for shape in shapes:
        size = math.prod(shape)
        parts.append(jax.lax.slice_in_dim(vectors, first, first + size).reshape(shape))
        first += size
    return parts
