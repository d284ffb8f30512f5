"""Parameters as a GPU likes them: vectors (biases, scales) joined into one, kernels turned.

An optimiser's kernel takes a GPU longer to start on a vector than to run, and every array that a
program is called with costs the host some microseconds; half of the paper's parameters are vectors.
Convolutions read their kernels, and write the gradients, with the outputs as the first axis: kept
that way, neither these nor what the optimiser knows of them are turned at every step.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct


class Joined(NamedTuple):
    """What `join` makes of parameters.

    Attributes:
      matrices: the parameters with None in the vectors' places; of kernels `[h, w, C, F]` the last
        axis is the first.
      vectors: `[n]`, all of them, in the order of jax's leaves.
    """

    matrices: Any
    vectors: jax.Array


def join(params: Any, like: Any) -> Joined:
    """The vectors of `params` joined. Which leaves are, the shapes `like` say: a matrix may be
    held flat."""
    leaves, tree = jax.tree.flatten(like)
    given = tree.flatten_up_to(params)
    matrices = [x if is_matrix(shape) else None for x, shape in zip(given, leaves, strict=True)]
    vectors = [x for x, shape in zip(given, leaves, strict=True) if not is_matrix(shape)]
    return Joined(tree.unflatten(_turned(matrices, -1, 0)), _concatenated(vectors))


def separate(joined: Joined, like: Any) -> Any:
    """The parameters, as they were."""
    leaves, tree = jax.tree.flatten(like)
    matrices = _turned(tree.flatten_up_to(joined.matrices), 0, -1)
    vectors = iter(_apart(joined.vectors, tuple(x.shape for x in leaves if not is_matrix(x))))
    given = zip(matrices, leaves, strict=True)
    return tree.unflatten([x if is_matrix(shape) else next(vectors) for x, shape in given])


class Packed(struct.PyTreeNode):
    """A network's parameters, joined, that know how they were.

    Attributes:
      joined: their arrays.
      like: their structure and the shapes of its leaves.
    """

    joined: Joined
    like: tuple[Any, tuple[jax.ShapeDtypeStruct, ...]] = struct.field(pytree_node=False)


def packed(params: Any) -> Packed:
    """A network's parameters as fewer arrays, which `applied` takes as it takes others."""
    leaves, tree = jax.tree.flatten(jax.eval_shape(lambda x: x, params))
    return Packed(join(params, tree.unflatten(leaves)), (tree, tuple(leaves)))


def applied(network: nn.Module) -> Callable[..., Any]:
    """`network.apply` of parameters that may be packed.

    Called within a loop it separates them there, in the kernels that use them; before the loop a
    GPU would need one for each.
    """

    def apply(params: Any, *given: Any, **options: Any) -> Any:
        if isinstance(params, Packed):
            tree, leaves = params.like
            params = separate(params.joined, tree.unflatten(leaves))
        return network.apply(params, *given, **options)

    return apply


def join_all(state: Any, like: Any) -> Any:
    """Whatever holds parameters (averages, moments) with each of them joined."""
    structure = jax.tree.structure(like)

    def are_params(x: Any) -> bool:
        return jax.tree.structure(x) == structure

    return jax.tree.map(lambda x: join(x, like) if are_params(x) else x, state, is_leaf=are_params)


def separate_all(state: Any, like: Any) -> Any:
    """The same with each of them as it was."""
    return jax.tree.map(
        lambda x: separate(x, like) if isinstance(x, Joined) else x,
        state,
        is_leaf=lambda x: isinstance(x, Joined),
    )


def is_matrix(x: Any) -> bool:
    """Whether a parameter of this shape stays as it is."""
    return x.ndim > 1


def _turned(matrices: list[Any], old: int, new: int) -> list[Any]:
    """Axis `old` of convolutions' kernels as axis `new`; the other matrices as they are."""
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
