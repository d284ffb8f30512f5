"""Several devices: each keeps, and updates, its own share of every large matrix (ZeRO, stage 2).

Rajbhandari et al., arXiv:1910.02054. A step gathers the matrices where the networks use them, in
the networks' type, and of the gradients' sum each device gets its own share alone. Reference: one
device, on which this module only keeps the rounded matrices.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh

from starjax.core import config
from starjax.core.types import ArrayTree, Tree
from starjax.policies.base import Params, Policy
from starjax.policies.models import kernels
from starjax.training import devices
from starjax.training.state import TrainState

LARGE = 1 << 18  # entries of a matrix: smaller ones take longer to send than to update everywhere
_ROW = 1 << 10  # entries that a block of a GPU's threads adds up at once
_SMALL = 1 << 16  # entries: starting on a smaller leaf takes a GPU longer than reading it


class StepCarry(NamedTuple):
    """State between two steps.

    Attributes:
      state: of the training, as `StateLayout` lays it out.
      rounded: its matrices in the networks' type, None for other leaves. The optimiser writes both:
        the float32 ones are not read again to round them.
    """

    state: TrainState
    rounded: Params


class StateLayout(NamedTuple):
    """The layout of a training's state on the devices between steps.

    Large matrices are flat and shared out over the devices; on a GPU vectors are packed.

    Attributes:
      mesh: the batch is split over it.
      round: parameters with large matrices in the type that is calculated in, `Policy.cast_params`.
      whole: shapes of the whole state, as a TrainState.
    """

    mesh: Mesh
    round: Callable[[Params], Params]
    whole: Any

    def transfers(
        self,
    ) -> tuple[Callable[[TrainState], StepCarry], Callable[[StepCarry], TrainState]]:
        """Returns `to_carry` and `to_state`, compiled where matrices move between devices."""
        if self.mesh.size == 1:
            return self.to_carry, self.to_state
        whole = devices.replicated(self.mesh)
        return (
            jax.jit(self.to_carry, out_shardings=self.shardings()),
            jax.jit(self.to_state, out_shardings=whole),
        )

    def to_carry(self, state: TrainState) -> StepCarry:
        """Lays out a whole state."""
        state = self._packed(state)
        carry = StepCarry(state, self.rounded(state.params))
        return jax.tree_util.tree_map_with_path(
            lambda path, x: x.reshape(-1) if self._is_shared_out(path, x) else x, carry
        )

    def to_state(self, carry: StepCarry) -> TrainState:
        """Returns the whole state."""
        shapes = self._packed_shapes(self.whole)
        state = jax.tree.map(
            lambda x, like: x if x.shape == like.shape else x.reshape(like.shape),
            carry.state,
            shapes,
        )
        return kernels.unpacked(state)

    def shapes(self) -> StepCarry:
        """Returns shapes and shardings of a carry."""
        shardings = {True: devices.batch_sharding(self.mesh), False: devices.replicated(self.mesh)}

        def one(path: tuple[Any, ...], x: jax.Array | jax.ShapeDtypeStruct) -> jax.ShapeDtypeStruct:
            shared_out = self._is_shared_out(path, x)
            shape = (x.size,) if shared_out else x.shape
            return jax.ShapeDtypeStruct(shape, x.dtype, sharding=shardings[shared_out])

        state = self._packed_shapes(self.whole)
        carry = StepCarry(state, jax.eval_shape(self.rounded, state.params))
        return jax.tree_util.tree_map_with_path(one, carry)

    def shardings(self) -> Any:
        """Returns shardings of a carry, for `jax.jit`."""
        if self.mesh.size == 1:
            return devices.replicated(self.mesh)
        return jax.tree.map(lambda x: x.sharding, self.shapes())

    def on_each_device(
        self, update: Callable[[StepCarry, Any], StepCarry]
    ) -> Callable[..., StepCarry]:
        """Runs `update(carry, batch)` on every device, of its shares of the two."""
        if self.mesh.size == 1:
            return update
        spec = jax.tree.map(lambda placed: placed.spec, self.shardings())
        batch = devices.batch_sharding(self.mesh).spec
        return jax.shard_map(
            update, mesh=self.mesh, in_specs=(spec, batch), out_specs=spec, check_vma=False
        )

    def params(self, carry: StepCarry) -> Params:
        """Returns the networks' parameters with rounded matrices, shared out as the carry."""
        return kernels.unpacked(_replaced(carry.state.params, carry.rounded))

    def rounded(self, params: ArrayTree) -> Any:
        """Returns a carry's matrices in the networks' type, None for other leaves."""
        types = self._packed_shapes(jax.eval_shape(self.round, self.whole.params))
        leaves, tree = jax.tree.flatten(params)
        return tree.unflatten(_rounded(leaves, tuple(x.dtype for x in jax.tree.leaves(types))))

    # Within `on_each_device`:

    def gather_params(self, params: Params) -> Params:
        """Gathers parameters; each device gets the sum of its share of their gradient."""
        if self.mesh.size == 1:
            return params
        # Its transpose is a reduce-scatter: gradients come out summed and shared out, without a
        # line for it.
        gather = functools.partial(jax.lax.all_gather, axis_name=devices.AXIS, tiled=True)
        return jax.tree.map(
            lambda x, like: x if x.shape == like.shape else gather(x).reshape(like.shape),
            params,
            self.whole.params,
        )

    def mean(self, tree: Tree) -> Tree:
        """Returns the mean of every device's numbers."""
        return tree if self.mesh.size == 1 else jax.lax.pmean(tree, devices.AXIS)

    def mean_gradients(self, gradients: Params) -> Any:
        """Returns the batch's gradients from each device's, laid out as a carry's parameters."""
        count, shapes = self.mesh.size, self._packed_shapes(self.whole.params)
        summed = self._packed(gradients)
        if summed is not gradients:  # packed: on a GPU
            summed = jax.tree.map(_row_major, summed)
        if count > 1:  # those of gathered matrices are summed already
            summed = jax.tree.map(
                lambda g, like: jax.lax.psum(g, devices.AXIS) if g.shape == like.shape else g,
                summed,
                shapes,
            )
        summed = jax.tree.map(lambda g, like: g.astype(like.dtype), summed, shapes)  # float32 again
        return jax.tree.map(lambda g: g / count, summed) if count > 1 else summed  # sum -> mean

    def norm(self, gradients: ArrayTree) -> jax.Array:
        """Returns the Euclidean norm of all gradients."""
        leaves = jax.tree.leaves(gradients)
        if self.mesh.size == 1:
            return jnp.sqrt(_squares(leaves))
        shapes = jax.tree.leaves(self._packed_shapes(self.whole.params))
        everywhere, shared_out = [], []
        for leaf, like in zip(leaves, shapes, strict=True):
            (everywhere if leaf.shape == like.shape else shared_out).append(leaf)
        return jnp.sqrt(_squares(everywhere) + jax.lax.psum(_squares(shared_out), devices.AXIS))

    def _packed(self, tree: Any) -> Any:
        return kernels.packed(tree, self.whole.params, self.mesh.devices.flat[0].platform)

    def _packed_shapes(self, shapes: Any) -> Any:
        """Returns shapes of the state, or of its parameters, packed but not shared out."""
        return jax.eval_shape(self._packed, shapes)

    def _is_shared_out(self, path: tuple[Any, ...], x: jax.Array | jax.ShapeDtypeStruct) -> bool:
        """Returns whether a leaf is shared out: a large matrix outside the image encoders.

        They are used first, and their gradients known last: nothing could run meanwhile.
        """
        count = self.mesh.size
        names = {getattr(key, "key", None) for key in path}
        large = x.ndim > 1 and x.size >= LARGE and x.size % count == 0
        return count > 1 and large and not names & {"vision", "depth"}


class Setup(NamedTuple):
    """Constants of a training, used by every step.

    Attributes:
      policy: to be trained.
      optimizer: from `state.make_optimizer`.
      policy_config: the horizons of a window.
      train_config: batch size and averaging.
      layout: of the state on the devices.
    """

    policy: Policy
    optimizer: optax.GradientTransformation
    policy_config: config.PolicyConfig
    train_config: config.TrainConfig
    layout: StateLayout


@functools.partial(jax.jit, static_argnums=1)  # called outside of any, one program for all of them
def _rounded(leaves: list[jax.Array], types: tuple[Any, ...]) -> list[jax.Array | None]:
    """Returns the leaves whose type changes, None for the others."""
    pairs = zip(leaves, types, strict=True)
    # None: not kept twice
    return [None if x.dtype == dtype else x.astype(dtype) for x, dtype in pairs]


def _replaced(tree: Tree, some: Tree) -> Tree:
    """Returns `tree` with the leaves of `some` that are not None."""
    return jax.tree.map(
        lambda one, leaf: leaf if one is None else one, some, tree, is_leaf=lambda x: x is None
    )


def _row_major(gradient: jax.Array) -> jax.Array:
    """Returns a convolution kernel's gradient in the order of its axes.

    XLA computes a 3x3 kernel's gradient as a forward convolution with another layout, and would
    transpose all of the optimiser's arrays to it, in five kernels. What is flat has one order only.
    """
    if gradient.ndim < 4:
        return gradient
    return jax.lax.optimization_barrier(gradient.ravel()).reshape(gradient.shape)


def _squares(leaves: list[jax.Array]) -> jax.Array:
    """Returns the sum of all squares.

    A GPU needs two kernels for the sum of a large array, and starting them takes longer than most
    of them run: the second is shared, and so are both of small arrays.
    """
    squares = [
        jnp.square(leaf).ravel() if leaf.size < _SMALL else _by_rows(leaf) for leaf in leaves
    ]
    # Without the barrier XLA takes the concatenation apart again.
    return jax.lax.optimization_barrier(jnp.concatenate([*squares, jnp.zeros(1)])).sum()


def _by_rows(leaf: jax.Array) -> jax.Array:
    """Squares summed along the last axis, of a vector `_ROW` at a time: one kernel."""
    if leaf.ndim == 1:
        leaf = jnp.pad(leaf, (0, -leaf.size % _ROW)).reshape(-1, _ROW)
    return jnp.square(leaf).sum(-1).ravel()
