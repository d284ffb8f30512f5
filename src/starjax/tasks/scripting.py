"""Common parts of scripted experts: smooth motion, jaws, rolls, and a disturbance to correct.

A policy that plans anew every few steps cannot tell how long a demonstration has stood still. So
motions spend little time near rest, and jaws are waited for no longer than they take to arrive.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.core.types import Command
from starjax.sim.state import EnvState
from starjax.sim.task import CONTROL_HZ

NOISE_STREAM = 1 << 20  # folded into the key: distinct from every attempt's stream
CORRELATION = 0.4  # s, correlation time of the disturbance
SMOOTHING = 0.15  # s, time constant of its low-pass, for smooth motion
SLOPE = 0.15  # part of a way's time, at either end, in which its speed changes
RAMP = 0.1  # s, the longest time of a `slope`
JAW_TIME = 0.25  # s to close or open
JAW_DELAY = 2.0 / CONTROL_HZ  # s, for which jaws are waited for at most
SHUT = 0.0  # opening below which jaws that touch something have it between them
OPENED = 0.8  # opening from which jaws are clear of an object


def slope(duration: jax.Array) -> jax.Array:
    """Returns the part of a way's time `[...]` (s) in which its speed changes, `RAMP` at most."""
    return jnp.minimum(SLOPE, RAMP / duration)


def sloped(fraction: jax.Array, slope: jax.Array | float = SLOPE) -> jax.Array:
    """Returns the fraction of the way after a fraction `[...]` of the time, at constant speed.

    Its speed grows and falls evenly during the part `slope` of the time at either end.
    """
    left = jnp.minimum(fraction, 1.0 - fraction)  # symmetric in time
    # Trapezoid of speed: its area up to SLOPE is a parabola, then a line.
    done = jnp.where(left < slope, left**2 / (2.0 * slope), left - slope / 2.0) / (1.0 - slope)
    return jnp.where(fraction < 0.5, done, 1.0 - done)


def jaws(before: jax.Array, target: jax.Array, elapsed: jax.Array) -> jax.Array:
    """Returns the openings `[...]` `elapsed` s after the start of a motion to `target`."""
    most = 2.0 * elapsed / JAW_TIME  # openings from -1 to 1 in JAW_TIME
    return before + jnp.clip(target - before, -most, most)


def is_of_jaws(jaws: np.ndarray | tuple[float, ...]) -> np.ndarray:
    """Returns `[P]` bool, True for phases in which jaws move, from their openings `[P, ...]`.

    The openings are those at the phases' ends. Such a phase ends once the jaws have arrived.
    """
    ends = np.reshape(jaws, (len(jaws), -1))
    return (np.diff(ends, axis=0, prepend=ends[:1]) != 0.0).any(-1)


def jaw_limit(before: jax.Array, target: jax.Array) -> jax.Array:
    """Returns the longest time (s) of a phase of jaws, from openings `[...]` to `target`."""
    return jnp.max(jnp.abs(target - before)) * JAW_TIME / 2.0 + JAW_DELAY


def have_arrived(target: jax.Array, state: EnvState) -> jax.Array:
    """Returns True once jaws `[A]` on their way to `target` grip, or are open."""
    # Contact alone is not yet a grip: jaws that still close would be stopped half-way.
    is_sent = state.gripper_target < target + 1e-3
    grip = is_sent & state.touch & (state.gripper < SHUT)
    return jnp.all(jnp.where(target < 0.0, grip, state.gripper > OPENED))


def is_over(script: Any, jaws: np.ndarray | tuple[float, ...], state: EnvState) -> jax.Array:
    """Returns True at the end of a script's present phase: of its time, or its jaws have arrived.

    `jaws` are openings `[P, ...]` as in `is_of_jaws`.
    """
    target = jnp.asarray(jaws, jnp.float32)[script.phase]
    has_arrived = jnp.asarray(is_of_jaws(jaws))[script.phase] & have_arrived(target, state)
    return (script.elapsed >= script.duration - 1e-6) | has_arrived


def command(roll: jax.Array, p: jax.Array, jaws: jax.Array, state: EnvState) -> Command:
    """Returns the command `[A]` of rolls `[A]` rad, tips `[A, 3]` m and jaws `[A]`.

    Shafts pass the measured trocars.
    """
    action = jnp.concatenate([roll[:, None], p], axis=-1)
    pose, _ = rcm.ACTION_SPACES["rcm4"].decode(action, state.measured_trocar)
    return Command(pose, jaws)


def turn_to(normal: jax.Array, R: jax.Array) -> jax.Array:
    """Returns the roll `[A]` (rad) that opens jaws along `normal` `[A, 3]`.

    `R` `[A, 3, 3]` are the tools' rotations at roll 0.
    """
    across = jnp.einsum("ai,aij->aj", normal, R, precision="highest")
    return jnp.arctan2(-across[:, 0], across[:, 1])  # across = R' n: the normal in the tool


def nearer_half(turned: jax.Array, roll: jax.Array) -> jax.Array:
    """Returns `turned` rad plus a multiple of half a turn (jaws are symmetric), next to `roll`."""
    # Within a quarter turn of `roll`
    return roll + (turned - roll + jnp.pi / 2) % jnp.pi - jnp.pi / 2


def disturb(key: jax.Array, noise: jax.Array, step: jax.Array, deviation: jax.Array) -> jax.Array:
    """Advances an Ornstein-Uhlenbeck process and its low-passed copy.

    Args:
      key: of the episode.
      noise: `[2, n]`, the last rough and smooth values.
      step: int32, the control step.
      deviation: `[n]`, standard deviation of the rough one.
    """
    dt = 1.0 / CONTROL_HZ
    keep = jnp.exp(-dt / CORRELATION)  # AR(1) factor of the sampled process
    drawn = jax.random.normal(
        jax.random.fold_in(jax.random.fold_in(key, NOISE_STREAM), step), deviation.shape
    )
    # Stationary variance deviation^2
    rough = keep * noise[0] + deviation * jnp.sqrt(1.0 - keep**2) * drawn
    smooth = noise[1] + dt / SMOOTHING * (rough - noise[1])  # first-order low-pass
    return jnp.stack([rough, smooth])
