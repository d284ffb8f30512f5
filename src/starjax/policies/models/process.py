"""Generative processes: noise is added to sequences, and a network learns to remove it."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax

from starjax.policies.models import diffusion as ddpm
from starjax.policies.models import flow as flow_matching
from starjax.policies.models import kernels, schedule
from starjax.policies.models import shortcut as shortcuts


class Sample(Protocol):
    """A way to generate sequences."""

    def __call__(
        self,
        predict: Callable[[jax.Array, Any], jax.Array],
        noise: jax.Array,
        *,
        prepare: Callable[[jax.Array], Any],
        reach: jax.Array | None,
    ) -> jax.Array:
        """Returns sequences from noise `[B, H, D]`, within `reach` `[2, D]`, None: [-1, 1].

        Args:
          predict: `(x, prepared)`, of `x` `[B, H, D]` at one time, or `[n, B, H, D]` at n times.
          noise: standard normal, or scaled by the temperature.
          prepare: maps times `[n]` to the second arguments of `predict`, a pytree `[n, ...]`.
          reach: lowest and highest values.
        """
        ...


class Process(NamedTuple):
    """A generative process: from data to noise and back.

    A time is the noise level of a sequence, input of the network, in the process's own unit.

    Attributes:
      noised: `(key, x0 [B, H, D]) -> given`, inputs and targets from clean sequences, about
        [-1, 1]: a pytree whose leading axis is the batch.
      loss: `(predict, given) -> scalar`, where `predict(x [B, H, D], time [B])` is the network;
        of some rows of the batch alone `predict(x [n, H, D], time [n], rows [n])`.
      sample: see `Sample`.
    """

    noised: Callable[[jax.Array, jax.Array], Any]
    loss: Callable[[Callable[..., jax.Array], Any], jax.Array]
    sample: Sample


def diffusion(diffusion_steps: int, ddim_steps: int) -> Process:
    """Makes denoising diffusion: K steps of a cosine schedule, sampled by DDIM."""
    tables = schedule.cosine(diffusion_steps)

    def noised(key: jax.Array, x0: jax.Array) -> ddpm.Noised:
        return ddpm.noised(tables, key, x0)

    def sample(predict, noise, *, prepare, reach=None):
        return kernels.choose("ddim_sample", ddpm.ddim_sample, len(noise), ddim_steps)(
            predict,
            noise,
            diffusion_steps=diffusion_steps,
            steps=ddim_steps,
            prepare=prepare,
            reach=reach,
        )

    return Process(noised, ddpm.eps_loss, sample)


def flow(steps: int) -> Process:
    """Makes flow matching on straight paths: a network predicts the velocity of Euler steps."""

    def sample(predict, noise, *, prepare, reach=None):
        return flow_matching.sample(predict, noise, steps=steps, prepare=prepare, reach=reach)

    return Process(flow_matching.noised, flow_matching.velocity_loss, sample)


def shortcut(correct_at: float = 0.0) -> Process:
    """Makes flow matching whose network also learns to take the whole path in one step.

    `correct_at`: see `shortcut.sample`.
    """
    sample = functools.partial(shortcuts.sample, correct_at=correct_at)
    return Process(shortcuts.noised, shortcuts.loss, sample)
