"""Flow matching whose network also knows the whole way: one evaluation from noise to a sequence.

Two things are learned at once. At any time the network predicts flow matching's velocity
(`models.flow`). Told that it is to go all the way, it predicts where its own flow ends, so that one
step does what many do: the distillation of Liu et al., "Flow Straight and Fast" (ICLR 2023), with
the flow in training as its teacher, and weights in common, as in Frans et al., "One Step Diffusion
via Shortcut Models" (ICLR 2025).

Other than in the latter, the whole way is not put together from halves of halves: each of these
must be learned before the next longer one can be.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax.models import flow
from starjax.models.diffusion import within

EVERY = 4  # one of so many sequences teaches the whole way
TEACHER_STEPS = 8  # Euler steps of the flow that teaches it
# The network is told the whole way as a time that no other is, in `flow.TIME_UNIT`: those of the
# flow end at 100.
WHOLE_WAY = 300.0


class NoisedShortcut(NamedTuple):
    """Sequences to learn from.

    Attributes:
      x: `[B, ...]`, with noise.
      time: `[B]`, what the network is told.
      velocity: `[B, ...]`, of the flow; it is not used of those that teach the whole way.
    """

    x: jax.Array
    time: jax.Array
    velocity: jax.Array


def noised(key: jax.Array, x0: jax.Array) -> NoisedShortcut:
    """Adds noise to clean sequences `[B, ...]` at a random time, or at a way's start.

    A way starts from a random share of the noise, as samples of any temperature do. `key` is one
    typed key for the whole batch.
    """
    key_flow, key_noise, key_share = jax.random.split(key, 3)
    at = flow.noised(key_flow, x0)
    goes = jnp.arange(len(x0)) % EVERY == 0
    share = _beside(jax.random.uniform(key_share, x0.shape[:1]), x0)
    start = share * jax.random.normal(key_noise, x0.shape, x0.dtype)
    return NoisedShortcut(
        jnp.where(_beside(goes, x0), start, at.x),
        jnp.where(goes, WHOLE_WAY, at.time),
        at.velocity,
    )


def loss(predict: Callable[..., jax.Array], given: NoisedShortcut) -> jax.Array:
    """Returns the mean squared error of the velocity, or of a whole way's mean velocity.

    It is what `predict(x, told)` `[B, ...]` predicts, of some rows `predict(x, told, rows)`.
    """
    target = jax.lax.stop_gradient(targets(predict, given))
    return jnp.mean((predict(given.x, given.time) - target) ** 2)


def targets(predict: Callable[..., jax.Array], given: NoisedShortcut) -> jax.Array:
    """Returns the target of the prediction `[B, ...]`: a whole way's mean velocity."""
    count = len(given.x)
    most = -(-count // EVERY)
    (rows,) = jnp.nonzero(given.time == WHOLE_WAY, size=most, fill_value=count)
    there = jnp.minimum(rows, count - 1)  # fewer than `most` in a share of the batch, perhaps
    start = given.x[there]

    def step(x: jax.Array, time: jax.Array) -> tuple[jax.Array, None]:
        told = jnp.full(most, time, start.dtype)
        return x - predict(x, told, there) / TEACHER_STEPS, None

    times = np.arange(TEACHER_STEPS, 0, -1, dtype=np.float32) / TEACHER_STEPS / flow.TIME_UNIT
    end, _ = jax.lax.scan(step, start, jnp.asarray(times))
    return given.velocity.at[rows].set(start - end, mode="drop")


def sample(
    predict: Callable[[jax.Array, Any], jax.Array],
    noise: jax.Array,
    *,
    prepare: Callable[[jax.Array], Any] = lambda time: time,
    reach: Any = None,
) -> jax.Array:
    """Takes one step from `noise` `[B, ...]` to a clean sequence, clipped to `reach`.

    Args:
      predict: `(x [B, ...], prepared) -> velocity [B, ...]`.
      noise: the start, standard normal or a share of it.
      prepare: maps what is told `[1]` to a pytree with leading axis 1; `predict` gets its slice.
      reach: (lowest, highest) value, each broadcastable against `[B, ...]`; None: -1 and 1.
    """
    prepared = jax.tree.map(lambda leaf: leaf[0], prepare(jnp.array([WHOLE_WAY])))
    return within(noise - predict(noise, prepared), reach)


def _beside(numbers: jax.Array, x: jax.Array) -> jax.Array:
    """Returns values `[B]` with the axes that broadcast against `x` `[B, ...]`."""
    return numbers.reshape(-1, *[1] * (x.ndim - 1))
