"""Common parts of scripted experts: smooth motion, jaws, turns, a disturbance they correct."""

import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.sim.state import EnvState
from starjax.sim.tasks.base import CONTROL_HZ
from starjax.types import Command

NOISE_STREAM = 1 << 20  # folded into the key: apart from every attempt's stream
CORRELATION = 0.4  # s, after which the disturbance forgets
SMOOTHING = 0.15  # s, of its low-pass: an arm's tool does not jump
JAW_TIME = 0.25  # s to close or open


def minimum_jerk(share: jax.Array) -> jax.Array:
    """Share of the way `[...]` after a `share` in [0, 1] of the time, at rest at both ends."""
    return share**3 * (10.0 + share * (-15.0 + 6.0 * share))


def jaws(before: jax.Array, wanted: jax.Array, elapsed: jax.Array) -> jax.Array:
    """Openings `[...]` in [-1, 1], `elapsed` s after they began to go from `before` to `wanted`."""
    return before + jnp.clip(elapsed / JAW_TIME, 0.0, 1.0) * (wanted - before)


def command(roll: jax.Array, p: jax.Array, jaws: jax.Array, state: EnvState) -> Command:
    """The command `[A]` of rolls `[A]` rad, tips `[A, 3]` m and jaws `[A]`, through the told
    trocars."""
    action = jnp.concatenate([roll[:, None], p], axis=-1)
    pose, _ = rcm.ACTION_SPACES["rcm4"].decode(action, state.measured_trocar)
    return Command(pose, jaws)


def turn_to(normal: jax.Array, R: jax.Array) -> jax.Array:
    """The roll `[A]` (rad) with which jaws open along `normal` `[A, 3]`; `R` `[A, 3, 3]`: of tools
    there at no roll."""
    across = jnp.einsum("ai,aij->aj", normal, R, precision="highest")
    return jnp.arctan2(-across[:, 0], across[:, 1])


def nearer_half(turned: jax.Array, roll: jax.Array) -> jax.Array:
    """`turned` rad, or half a turn from it, as jaws are the same then: the one nearer to `roll`."""
    return roll + (turned - roll + jnp.pi / 2) % jnp.pi - jnp.pi / 2


def disturb(key: jax.Array, noise: jax.Array, step: jax.Array, deviation: jax.Array) -> jax.Array:
    """The next value of an Ornstein-Uhlenbeck process and of its low-passed copy.

    Args:
      key: of the episode.
      noise: `[2, n]`, the last rough and smooth values.
      step: int32, the control step.
      deviation: `[n]`, standard deviation of the rough one.
    """
    dt = 1.0 / CONTROL_HZ
    keep = jnp.exp(-dt / CORRELATION)
    drawn = jax.random.normal(
        jax.random.fold_in(jax.random.fold_in(key, NOISE_STREAM), step), deviation.shape
    )
    rough = keep * noise[0] + deviation * jnp.sqrt(1.0 - keep**2) * drawn
    smooth = noise[1] + dt / SMOOTHING * (rough - noise[1])
    return jnp.stack([rough, smooth])
