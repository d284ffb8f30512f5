"""Inputs of RCM maps: one float type, checked shapes, safe directions."""

import functools
import inspect
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import core
from jax.extend.core import get_opaque_trace_state
from jax.typing import ArrayLike

MAX_PROGRAMS = 64  # programs of a map, one per combination of shapes and types
_VALUES = (jax.Array, np.ndarray, np.number, np.bool_, int, float)
_BOUND = 1e30  # bound of finite inputs: their sums and squares do not overflow

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

# jax's state outside of every program: that of a new thread, as a program may import this module.
with ThreadPoolExecutor(1) as _thread:
    _OUTSIDE = _thread.submit(get_opaque_trace_state).result()


def broadcasting(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Lets arrays of `function` differ in number of axes and in type, and be numpy's.

    This also holds in a program whose settings of jax forbid it (`jax_numpy_rank_promotion`,
    `jax_numpy_dtype_promotion`, `jax_transfer_guard`).
    """

    @functools.wraps(function)
    def mapped(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        with (
            jax.numpy_rank_promotion("allow"),
            jax.numpy_dtype_promotion("standard"),
            jax.transfer_guard("allow"),
        ):
            return function(*args, **kwargs)

    return mapped


def compiled(*static: str) -> Callable[[Callable[Arguments, Result]], Callable[Arguments, Result]]:
    """Lets a map broadcast, and run as one program where its arrays are concrete.

    Operation by operation, as a loop of a robot or a notebook calls them, a map of forty operations
    takes 5 ms; its program 0.1 ms. A program is kept for each combination of shapes and types, at
    most `MAX_PROGRAMS` a map. With tracers, and within a program, the map is traced as it is.

    Args:
      static: names of arguments that are part of the program, such as the sizes of a wrist.
    """

    def decorate(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
        program = jax.jit(function, static_argnames=static)
        names = tuple(inspect.signature(function).parameters)

        @functools.wraps(function)
        def mapped(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
            given = dict(zip(names, args)) | kwargs
            fixed = [given.pop(name, None) for name in static]
            if not _are_concrete(given) or not _are_numbers(fixed):
                return function(*args, **kwargs)
            if program._cache_size() >= MAX_PROGRAMS:
                program.clear_cache()
            try:
                return program(*args, **kwargs)
            except (TypeError, ValueError):  # jax adds lines to them; a mistake is one line
                return function(*args, **kwargs)

        return broadcasting(mapped)

    return decorate


def _are_concrete(values: Any) -> bool:
    """Returns True for numbers and arrays outside of any program."""
    leaves = jax.tree.leaves(values)
    if any(isinstance(x, core.Tracer) or not isinstance(x, _VALUES) for x in leaves):
        return False
    return get_opaque_trace_state() == _OUTSIDE


def _are_numbers(values: Any) -> bool:
    return all(isinstance(x, int | float | np.number) for x in jax.tree.leaves(values))


def checked(**named: tuple[Any, tuple[int, ...]]) -> list[jax.Array]:
    """Converts inputs to one float type of at least 32 bits and check their shapes.

    Args:
      named: argument name to `(value, trailing shape)`; the leading axes must broadcast.

    Returns:
      The values as arrays, in the order given.

    Raises:
      ValueError: a value is a struct as `Trocar`, a trailing shape differs, or the leading axes do
        not broadcast.
    """
    for name, (value, _) in named.items():
        # Its fields would be read as coordinates.
        if hasattr(value, "_fields"):
            raise ValueError(f"{name}: expected an array, got {type(value).__name__}")
    values = {name: jnp.asarray(value) for name, (value, _) in named.items()}
    leading = {}  # axes before the trailing ones
    for name, (_, trailing) in named.items():
        shape, n = values[name].shape, len(trailing)
        if len(shape) < n or shape[len(shape) - n :] != trailing:
            expected = ", ".join(["...", *map(str, trailing)])
            raise ValueError(f"{name}: expected shape [{expected}], got {list(shape)}")
        leading[name] = shape[: len(shape) - n]
    try:
        jnp.broadcast_shapes(*leading.values())
    except ValueError:
        got = ", ".join(f"{name} {list(shape)}" for name, shape in leading.items())
        raise ValueError(
            f"{', '.join(named)}: expected leading axes that broadcast, got {got}"
        ) from None
    dtype = jnp.result_type(jnp.float32, *values.values())
    return [value.astype(dtype) for value in values.values()]


def bounded(x: jax.Array) -> jax.Array:
    """Sets non-finite entries of `x` to 0 and clips the others to +-1e30."""
    return jnp.clip(jnp.where(jnp.isfinite(x), x, 0.0), -_BOUND, _BOUND)


def taint(x: jax.Array) -> jax.Array:
    """Returns `[..., 1]`: 0 if all of `x` `[..., n]` are finite, else NaN.

    A constant NaN would trip `jax_debug_nans` even for finite inputs.
    """
    return jnp.sum(x - x, axis=-1, keepdims=True)  # x - x is 0, or NaN for NaN and infinity


def epsilon(dtype: np.dtype) -> float:
    """Returns the length (m, or sine of an angle) below which a direction is undefined.

    It also bounds derivatives: they grow like 1 / length towards a singular point.
    """
    return 5e-7 if jnp.finfo(dtype).bits == 32 else 1e-12


def direction(v: jax.Array, fallback: ArrayLike) -> tuple[jax.Array, jax.Array]:
    """Splits any finite `v` into its direction and its length.

    Args:
      v: `[..., 3]`.
      fallback: `[..., 3]` unit vector returned where `v` is shorter than `epsilon`.

    Returns:
      `[..., 3]` unit vector; `[...]` length, 0 where the fallback was taken.
    """
    # The quotient does not depend on the scale, which therefore needs no derivative.
    scale = jax.lax.stop_gradient(jnp.max(jnp.abs(v), axis=-1, keepdims=True))
    is_defined = scale > epsilon(v.dtype)
    scaled = jnp.where(is_defined, v / jnp.where(is_defined, scale, 1.0), fallback)
    length = jnp.sqrt(dot(scaled, scaled))  # entries of order one: no overflow, no underflow
    return scaled / length, jnp.where(is_defined, scale * length, 0.0)[..., 0]


def norm(v: jax.Array) -> jax.Array:
    """Returns the length `[...]` of `v` `[..., 3]`, its derivative zero at zero."""
    scale = jax.lax.stop_gradient(jnp.max(jnp.abs(v), axis=-1, keepdims=True))
    # Not `scale > tiny`: a NaN must propagate.
    is_zero = scale <= jnp.finfo(v.dtype).tiny
    scaled = jnp.where(is_zero, 1.0, v) / jnp.where(is_zero, 1.0, scale)
    length = scale * jnp.sqrt(dot(scaled, scaled))
    return jnp.where(is_zero, 0.0, length)[..., 0]


def dot(a: jax.Array, b: jax.Array) -> jax.Array:
    """Returns the inner product over the last axis, `[..., 1]`."""
    return _sum(a[..., i : i + 1] * b[..., i : i + 1] for i in range(a.shape[-1]))


# Products are written out: reductions would not fuse with later operations on a CPU, and matrix
# products would be rounded to TF32 on a GPU.


def matmul(A: jax.Array, B: jax.Array) -> jax.Array:
    """Multiplies `[..., 3, 3]` matrices in full precision."""
    return _sum(A[..., :, i : i + 1] * B[..., i : i + 1, :] for i in range(3))


def matvec(A: jax.Array, v: jax.Array) -> jax.Array:
    """Multiplies `[..., 3, 3]` by `[..., 3]` in full precision."""
    return _sum(A[..., :, i] * v[..., i : i + 1] for i in range(3))


def _sum(terms: Iterable[jax.Array]) -> jax.Array:
    return functools.reduce(jnp.add, terms)
