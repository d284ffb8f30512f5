"""Distillation: a policy's own flow, frozen, teaches it to decide in one step.

While `onestep` trains, a quarter of each batch learns the whole way from a teacher that changes
with every step and does not clip, at states of demonstrations. Here the teacher is the averaged
flow as it is sampled: clipped, at the temperature in use. Every window of demonstrations learns the
whole way, and so do states that the policy itself visits, as in DAgger (arXiv:1011.0686), with the
flow as the expert. The loss of the flow on demonstrations is added, because both share their
weights.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from starjax.addons.finetune.explore import Experience
from starjax.core import config
from starjax.core.types import Observation
from starjax.data import windows
from starjax.policies.base import Params, Policy
from starjax.policies.learners.flow import FlowConfig
from starjax.policies.learners.unet import UnetConfig
from starjax.training import state as training


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


class Visited(NamedTuple):
    """M states that the policy has visited.

    Attributes:
      observation: `[M, O, ...]`, with features instead of images.
      trocar: measured frames `[M]`.
    """

    observation: Observation
    trocar: Any


def visited(played: Experience, draws: np.random.Generator) -> Visited:
    """Returns states before decisions of some episodes, as many as these have places for."""
    alive = np.flatnonzero(played.alive)
    rows = draws.choice(alive, played.alive.size)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[rows], played.observation)
    episode = rows // played.alive.shape[1]
    return Visited(flat, jax.tree.map(lambda x: x[episode], played.trocar))


def flow_settings(policy: config.PolicyConfig) -> config.PolicyConfig:
    """Returns the settings of the flow that a policy of the learner `onestep` also is."""
    names = [field.name for field in dataclasses.fields(UnetConfig)]
    options = FlowConfig(**{name: getattr(policy.options, name) for name in names})
    return dataclasses.replace(policy, learner="flow", options=options)


def begin(train: config.TrainConfig, params: Params) -> Student:
    """Returns the state before the first step."""
    return Student(params, params, training.make_optimizer(train).init(params))


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
      learn(student, teacher's parameters, stats, Demonstrations, Visited, key, first, count) ->
      Student, the mean squared error of the last step.
    """
    optimizer = training.make_optimizer(train)
    generate, show = policy.generate, flow.generate
    assert generate is not None and show is not None

    @jax.jit
    def learn(student, frozen, stats, demonstrations, visited, key, first, count):
        def step(i, carry):
            student, _ = carry
            keys = jax.random.split(jax.random.fold_in(key, i), 4)
            key_rows, key_loss, key_noise, key_own = keys
            frames = jax.random.choice(key_rows, demonstrations.frames, (train.batch_size,))
            batch = windows.gather(
                demonstrations.dataset, frames, settings.obs_horizon, settings.horizon
            )
            prepared = flow.prepare(stats, key_loss, batch)
            own = jax.random.randint(key_own, frames.shape, 0, len(visited.trocar.roll_zero))
            here = jax.tree.map(lambda leaf: leaf[own], visited)
            states = (batch.observation, batch.trocar), (here.observation, here.trocar)
            seen = [
                (jax.random.split(jax.random.fold_in(key_noise, part), len(frames)), *state)
                for part, state in enumerate(states)
            ]
            targets = [show(frozen, stats, *one, True) for one in seen]

            def loss(params):
                ends = [generate(params, stats, *one) for one in seen]
                error = jnp.mean((jnp.stack(ends) - jnp.stack(targets)) ** 2)
                return flow.loss(params, prepared)[0] + error, error

            gradient, error = jax.grad(loss, has_aux=True)(student.params)
            change, memory = optimizer.update(gradient, student.optimizer, student.params)
            params = optax.apply_updates(student.params, change)
            decay = training.ema_decay(i, train.ema_max)
            average = optax.incremental_update(params, student.average, 1.0 - decay)
            return Student(params, average, memory), error

        return jax.lax.fori_loop(first, first + count, step, (student, jnp.zeros(())))

    return learn
