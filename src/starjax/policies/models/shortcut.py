"""Flow matching with a shortcut: one network evaluation from noise to a sequence.

Two things are learned at once. At any time the network predicts flow matching's velocity
(`models.flow`). For the time WHOLE_WAY it predicts the end of its own flow: one step replaces
many. This is the distillation of Liu et al., "Flow Straight and Fast" (ICLR 2023), with
the flow in training as its teacher, and weights in common, as in Frans et al., "One Step Diffusion
via Shortcut Models" (ICLR 2025).

Unlike the latter, the whole path is not composed of halves of halves: each of these must be learned
before the next longer one.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from starjax.policies.models import flow
from starjax.policies.models.diffusion import within

EVERY = 4  # one sequence in EVERY trains the whole path
TEACHER_STEPS = 8  # Euler steps of the flow, its target
# The network's time for the whole path, in `flow.TIME_UNIT`: times of the flow end at 100.
WHOLE_WAY = 300.0


def noised(key: jax.Array, x0: jax.Array) -> flow.NoisedFlow:
    """Adds noise to clean sequences `[B, ...]` at a random time, or at a path's start.

    A path starts from noise of a random scale, as samples of any temperature do. `key` is one
    typed key for the whole batch.
    """
    key_flow, key_noise, key_share = jax.random.split(key, 3)
    at = flow.noised(key_flow, x0)
    # By place, not by draw: each device has equally many, and their targets a fixed shape.
    is_whole = jnp.arange(len(x0)) % EVERY == 0
    scale = _expand(jax.random.uniform(key_share, x0.shape[:1]), x0)
    start = scale * jax.random.normal(key_noise, x0.shape, x0.dtype)  # any temperature in [0, 1]
    return flow.NoisedFlow(
        jnp.where(_expand(is_whole, x0), start, at.x),
        jnp.where(is_whole, WHOLE_WAY, at.time),
        at.velocity,
    )


def loss(predict: Callable[..., jax.Array], batch: flow.NoisedFlow) -> jax.Array:
    """Returns the mean squared error of the velocity, or of a whole path's mean velocity.

    `predict(x, time)` returns it `[B, ...]`, `predict(x, time, rows)` for some rows of the batch.
    """
    # The teacher learns from the flow alone
    target = jax.lax.stop_gradient(targets(predict, batch))
    return jnp.mean((predict(batch.x, batch.time) - target) ** 2)


def targets(predict: Callable[..., jax.Array], batch: flow.NoisedFlow) -> jax.Array:
    """Returns targets `[B, ...]`: the flow's velocity, or a whole path's mean velocity."""
    count = len(batch.x)
    most = -(-count // EVERY)  # rounded up
    (rows,) = jnp.nonzero(batch.time == WHOLE_WAY, size=most, fill_value=count)
    there = jnp.minimum(rows, count - 1)  # a device's part of the batch may have fewer than `most`
    start = batch.x[there]

    def step(x: jax.Array, time: jax.Array) -> tuple[jax.Array, None]:
        times = jnp.full(most, time, start.dtype)
        return x - predict(x, times, there) / TEACHER_STEPS, None  # Euler: x - v dt

    times = np.arange(TEACHER_STEPS, 0, -1, dtype=np.float32) / TEACHER_STEPS / flow.TIME_UNIT
    # The teacher integrates the flow from t = 1 to 0; the path's mean velocity is start - end.
    end, _ = jax.lax.scan(step, start, jnp.asarray(times))
    return batch.velocity.at[rows].set(start - end, mode="drop")  # fill values lie outside: dropped


def sample(
    predict: Callable[[jax.Array, Any], jax.Array],
    noise: jax.Array,
    *,
    correct_at: float = 0.0,
    prepare: Callable[[jax.Array], Any] = lambda time: time,
    reach: jax.Array | None = None,
) -> jax.Array:
    """Takes one step from `noise` `[B, ...]` to a clean sequence, clipped to `reach`.

    Args:
      predict: `(x [B, ...], prepared) -> velocity [B, ...]`.
      noise: the start, standard normal or scaled by the temperature.
      correct_at: time t at which a second evaluation corrects the sequence: the straight path from
        noise to it, at t, is the start of one step of the flow. 0 for a single evaluation.
      prepare: maps times `[n]` to a pytree with leading axis n; `predict` gets its slices.
      reach: lowest and highest value, each broadcast against `[B, ...]`; None: -1 and 1.
    """
    times = [WHOLE_WAY, correct_at / flow.TIME_UNIT] if correct_at else [WHOLE_WAY]
    prepared = prepare(jnp.array(times))
    whole_way, at = (jax.tree.map(lambda leaf, i=i: leaf[i], prepared) for i in (0, -1))
    clean = within(noise - predict(noise, whole_way), reach)  # x_0 = x_1 - (mean velocity) * 1
    if not correct_at:
        return clean
    x = clean + correct_at * (noise - clean)  # noised to t again, with the same noise
    return within(x - correct_at * predict(x, at), reach)  # x_0 = x_t - t v(x_t, t)


def _expand(numbers: jax.Array, x: jax.Array) -> jax.Array:
    """Returns values `[B]` with the axes that broadcast against `x` `[B, ...]`."""
    return numbers.reshape(-1, *[1] * (x.ndim - 1))
