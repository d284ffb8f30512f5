"""A loop that improves an iterate until it is accurate, and that always ends."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp

Iterate = TypeVar("Iterate")


def improve_while(
    is_coarse: Callable[[Iterate], jax.Array],
    improve: Callable[[Iterate], Iterate],
    start: Iterate,
    max_iterations: int,
) -> Iterate:
    """Applies `improve` while `is_coarse`, at most `max_iterations` times, single-sample.

    The flag is part of the loop's state. Under `vmap` jax evaluates a condition twice, for the loop
    and to select the lanes that change. The compiler may round these two differently: a lane at the
    limit of accuracy could keep the loop running without ever changing itself.

    Args:
      is_coarse: returns a flag `[]`.
      start: a pytree.
    """

    def body(loop: tuple[jax.Array, jax.Array, Iterate]) -> tuple[jax.Array, jax.Array, Iterate]:
        count, _, now = loop
        now, count = improve(now), count + 1
        return count, (count < max_iterations) & is_coarse(now), now

    is_first = jnp.logical_and(max_iterations > 0, is_coarse(start))
    start_loop = jnp.zeros((), jnp.int32), is_first, start
    _, _, end = jax.lax.while_loop(lambda loop: loop[1], body, start_loop)
    return end
