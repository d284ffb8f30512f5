"""Distillation: a policy's own flow, frozen, teaches it to decide in one step.

While `onestep` trains, a quarter of each batch learns the whole way from a teacher that changes
with every step and does not clip. Here the teacher is the averaged flow as it is sampled: clipped,
at the temperature in use; every window learns the whole way. The loss of the flow on
demonstrations is added, because both share their weights.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from starjax import config
from starjax.data import windows
from starjax.policies.base import Params, Policy
from starjax.policies.learners.flow import FlowConfig
from starjax.policies.learners.unet import UnetConfig
from starjax.training import state as states


class Student(NamedTuple):
    """State of the learning.

    Attributes:
      params: of the policy, without a vision encoder.
      average: their exponential moving average.
      optimizer: its state.
    """

    params: Any
    average: Any
    optimizer: Any


def flow_settings(policy: config.PolicyConfig) -> config.PolicyConfig:
    """Returns the settings of the flow that a policy of the learner `onestep` also is."""
    names = [field.name for field in dataclasses.fields(UnetConfig)]
    options = FlowConfig(**{name: getattr(policy.options, name) for name in names})
    return dataclasses.replace(policy, learner="flow", options=options)


def begin(train: config.TrainConfig, params: Params) -> Student:
    """Returns the state before the first step."""
    return Student(params, params, states.make_optimizer(train).init(params))


def make(
    policy: Policy, flow: Policy, settings: config.PolicyConfig, train: config.TrainConfig
) -> Callable[..., tuple[Student, jax.Array]]:
    """Builds the program of some steps.

    Args:
      policy: the student.
      flow: the same networks as a flow, see `flow_settings`; its `prepare` reads features instead
        of images.
      settings: of the policy.
      train: optimiser, batch size and averaging.

    Returns:
      learn(student, teacher's parameters, stats, Demonstrations, key, first, count) -> Student, the
      mean squared error of the last step.
    """
    optimizer = states.make_optimizer(train)
    generate, show = policy.generate, flow.generate
    assert generate is not None and show is not None

    @jax.jit
    def learn(student, frozen, stats, demonstrations, key, first, count):
        def step(i, carry):
            student, _ = carry
            key_rows, key_loss, key_noise = jax.random.split(jax.random.fold_in(key, i), 3)
            frames = jax.random.choice(key_rows, demonstrations.frames, (train.batch_size,))
            batch = windows.gather(
                demonstrations.dataset, frames, settings.obs_horizon, settings.horizon
            )
            prepared = flow.prepare(stats, key_loss, batch)
            keys = jax.random.split(key_noise, train.batch_size)
            seen = keys, batch.observation, batch.trocar
            target = show(frozen, stats, *seen, True)

            def loss(params):
                error = jnp.mean((generate(params, stats, *seen) - target) ** 2)
                return flow.loss(params, prepared)[0] + error, error

            gradient, error = jax.grad(loss, has_aux=True)(student.params)
            change, state = optimizer.update(gradient, student.optimizer, student.params)
            params = optax.apply_updates(student.params, change)
            decay = states.ema_decay(i, train.ema_max)
            average = optax.incremental_update(params, student.average, 1.0 - decay)
            return Student(params, average, state), error

        return jax.lax.fori_loop(first, first + count, step, (student, jnp.zeros(())))

    return learn
