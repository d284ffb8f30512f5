"""Several devices: each keeps, and updates, its own part of every large matrix (ZeRO, stage 2).

Rajbhandari et al., arXiv:1910.02054. A step puts the matrices together where the networks use them,
in the networks' type, and of the gradients' sum each device gets its part alone. On one device all
of this does nothing.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from starjax.models.kernels import packed_params
from starjax.policies.base import Params
from starjax.training import devices
from starjax.training.state import TrainState

Carried = tuple[TrainState, Params]

LARGE = 1 << 18  # entries of a matrix: smaller ones take longer to send than to update everywhere
_ROW = 1 << 10  # entries: what a block of a GPU's threads adds up at once
_SMALL = 1 << 16  # entries: a leaf below takes a GPU longer to start on than to read


class Parts(NamedTuple):
    """How a state lies on the devices from step to step.

    What is carried is the state and its `rounded` matrices: the optimiser writes both, so that the
    float32 ones are not read again to round them. Matrices in parts are flat there, and on a GPU
    vectors are joined.

    Attributes:
      mesh: the batch is split over it.
      round: parameters with large matrices in the type that is calculated in, `Policy.rounded`.
      like: the whole state's shapes, as a TrainState.
    """

    mesh: Mesh
    round: Callable[[Params], Params]
    like: Any

    def begin(self, state: TrainState) -> Carried:
        """What is carried, of a whole state."""
        state = self._join(state)
        return jax.tree_util.tree_map_with_path(
            lambda path, x: x.reshape(-1) if self._is_split(path, x) else x,
            (state, self.rounded(state.params)),
        )

    def end(self, carried: Carried) -> TrainState:
        """The whole state of what is carried."""
        state = jax.tree.map(
            lambda x, like: x if x.shape == like.shape else x.reshape(like.shape),
            carried[0],
            self._joined(self.like),
        )
        return self._separate(state)

    def on_each(self, update: Callable[[Carried, Any], Carried]) -> Callable[..., Carried]:
        """`update(carried, batch)` on every device, of its parts and its share of the batch."""
        if self.mesh.size == 1:
            return update
        spec = jax.tree.map(lambda placed: placed.spec, self.placed())
        share = devices.batch_sharding(self.mesh).spec
        return jax.shard_map(
            update, mesh=self.mesh, in_specs=(spec, share), out_specs=spec, check_vma=False
        )

    def placed(self) -> Any:
        """Shardings of what is carried."""
        if self.mesh.size == 1:
            return devices.replicated(self.mesh)
        return jax.tree.map(lambda x: x.sharding, self.carried())

    def carried(self) -> Any:
        """Shapes and places of what is carried."""
        placed = {True: devices.batch_sharding(self.mesh), False: devices.replicated(self.mesh)}

        def one(path: tuple[Any, ...], x: Any) -> jax.ShapeDtypeStruct:
            split = self._is_split(path, x)
            shape = (x.size,) if split else x.shape
            return jax.ShapeDtypeStruct(shape, x.dtype, sharding=placed[split])

        state = self._joined(self.like)
        narrow = jax.eval_shape(self.rounded, state.params)
        return jax.tree_util.tree_map_with_path(one, (state, narrow))

    def params(self, carried: Carried) -> Params:
        """The networks' parameters, matrices in their type; those in parts still are."""
        state, narrow = carried
        if self._joins:
            params = state.params._replace(matrices=_taken(narrow, state.params.matrices))
            return self._separate(params)
        return _taken(narrow, state.params)

    def rounded(self, params: Any) -> Params:
        """The matrices of a carried state's parameters, as they are carried beside it."""
        return rounded(params.matrices if self._joins else params, self.round)

    def whole(self, params: Params) -> Params:
        """Parameters put together, within `on_each`; differentiated, sums come back as parts."""
        if self.mesh.size == 1:
            return params
        gather = functools.partial(jax.lax.all_gather, axis_name=devices.AXIS, tiled=True)
        return jax.tree.map(
            lambda x, like: x if x.shape == like.shape else gather(x).reshape(like.shape),
            params,
            self.like.params,
        )

    def mean(self, tree: Any) -> Any:
        """Of every device's numbers, within `on_each`."""
        return tree if self.mesh.size == 1 else jax.lax.pmean(tree, devices.AXIS)

    def mean_gradient(self, gradients: Params) -> Any:
        """Each device's gradients of `whole` parameters as the batch's, joined as those are."""
        count, like = self.mesh.size, self._joined(self.like.params)
        summed = self._join(gradients)
        if self._joins:
            summed = jax.tree.map(_as_it_lies, summed)
        if count > 1:
            summed = jax.tree.map(
                lambda g, like: jax.lax.psum(g, devices.AXIS) if g.shape == like.shape else g,
                summed,
                like,
            )
        summed = jax.tree.map(lambda g, like: g.astype(like.dtype), summed, like)
        return jax.tree.map(lambda g: g / count, summed) if count > 1 else summed

    def norm(self, gradients: Any) -> jax.Array:
        """Euclidean norm of all of them, within `on_each`."""
        leaves = jax.tree.leaves(gradients)
        if self.mesh.size == 1:
            return jnp.sqrt(_squares(leaves))
        of: dict[bool, list[jax.Array]] = {True: [], False: []}
        for leaf, like in zip(leaves, jax.tree.leaves(self._joined(self.like.params)), strict=True):
            of[leaf.shape == like.shape].append(leaf)
        return jnp.sqrt(_squares(of[True]) + jax.lax.psum(_squares(of[False]), devices.AXIS))

    def _joined(self, like: Any) -> Any:
        """Shapes of the state, or of its parameters, as they are carried but for the parts."""
        return jax.eval_shape(self._join, like)

    def _join(self, tree: Any) -> Any:
        return packed_params.pack_all(tree, self.like.params) if self._joins else tree

    def _separate(self, tree: Any) -> Any:
        return packed_params.unpack_all(tree, self.like.params) if self._joins else tree

    @property
    def _joins(self) -> bool:
        return packed_params.pays(self.mesh.devices.flat[0].platform)

    def _is_split(self, path: tuple[Any, ...], x: Any) -> bool:
        """Whether a leaf of what is carried lies in parts: not the vision encoder's, which is the
        first to be used and the last whose gradient is known, so that nothing could run beside."""
        count = self.mesh.size
        names = {getattr(key, "key", None) for key in path}
        large = x.ndim > 1 and x.size >= LARGE and x.size % count == 0
        return count > 1 and large and "vision" not in names


@functools.partial(jax.jit, static_argnums=1)  # outside of any, one program for all of them
def rounded(params: Params, change: Callable[[Params], Params]) -> Params:
    """The matrices that `Policy.rounded` changes, as it gives them; None instead of the others."""
    changed = change(params)
    return jax.tree.map(lambda old, new: None if new.dtype == old.dtype else new, params, changed)


def _taken(some: Any, tree: Any) -> Any:
    """`tree` with those of its leaves replaced that are not None in `some`."""
    return jax.tree.map(
        lambda one, leaf: leaf if one is None else one, some, tree, is_leaf=_is_none
    )


def _is_none(x: Any) -> bool:
    return x is None


def _as_it_lies(gradient: jax.Array) -> jax.Array:
    """A gradient; of a convolution's kernel one that is written in the order of its axes.

    Over 3x3 pixels XLA has it from a forward convolution, whose result lies otherwise, and would
    turn each of the optimiser's arrays instead, in five kernels. What is flat has one order only.
    """
    if gradient.ndim < 4:
        return gradient
    return jax.lax.optimization_barrier(gradient.ravel()).reshape(gradient.shape)


def _squares(leaves: list[jax.Array]) -> jax.Array:
    """Sum of all squares. A GPU needs two kernels for the sum of a large array, and starting them
    takes longer than most of them run: the second is shared, and so are both of small ones."""
    found = [jnp.square(leaf).ravel() if leaf.size < _SMALL else _by_rows(leaf) for leaf in leaves]
    # without the barrier XLA takes apart again what is put together
    return jax.lax.optimization_barrier(jnp.concatenate([*found, jnp.zeros(1)])).sum()


def _by_rows(leaf: jax.Array) -> jax.Array:
    """Its squares summed along the last axis, or `_ROW` at a time: one kernel."""
    if leaf.ndim == 1:
        leaf = jnp.pad(leaf, (0, -leaf.size % _ROW)).reshape(-1, _ROW)
    return jnp.square(leaf).sum(-1).ravel()
