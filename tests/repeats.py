"""A learner's model that learns to repeat two sequences, without a policy around it."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from starjax.core import config
from starjax.core.learners import LEARNERS
from starjax.policies import sequences

ACTION = 2
STEPS = 400
PRESENT = jnp.array([[0.7, -0.6], [-0.5, 0.8]])  # shape of two samples


def model(settings: config.PolicyConfig) -> sequences.SequenceModel:
    sizes = sequences.Sizes(settings.horizon, ACTION, 2, 0, ACTION, 0)
    return LEARNERS.get(settings.learner).make(settings.options, settings, sizes)


def condition(state: jax.Array) -> sequences.Condition:
    return sequences.Condition(None, state, jnp.zeros((len(state), 0)))


def learned(settings: config.PolicyConfig) -> tuple[Any, jax.Array]:
    """Parameters of a model that repeats two sequences `[2, H, ACTION]`, and the sequences."""
    learner = model(settings)
    ramp = jnp.linspace(0.0, 0.2, settings.horizon)[:, None]
    wanted = PRESENT[:, None] + ramp * jnp.array([1.0, -1.0])
    optimizer = optax.adam(optax.cosine_decay_schedule(1e-2, STEPS))

    def repeated(x):
        return jnp.repeat(x, 16, axis=0)

    def loss(params, given):
        return learner.loss(params, condition(repeated(PRESENT)), given)[0]

    def step(i, carry):
        params, state = carry
        given = learner.prepare(jax.random.fold_in(jax.random.key(1), i), repeated(wanted))
        gradient = jax.grad(loss)(params, given)
        updates, state = optimizer.update(gradient, state, params)
        return optax.apply_updates(params, updates), state

    @jax.jit
    def train(key):
        params = learner.init(key)
        return jax.lax.fori_loop(0, STEPS, step, (params, optimizer.init(params)))[0]

    return train(jax.random.key(0)), wanted


def sampled(settings: config.PolicyConfig, params: Any, seed: int = 2) -> np.ndarray:
    """`[2, H, ACTION]` of its output."""
    keys = jax.random.split(jax.random.key(seed), len(PRESENT))
    sample = jax.jit(model(settings).sample)
    return np.asarray(sample(params, keys, condition(PRESENT), None))
