"""A learner with a scalar parameter: a linear map, and one gain of all actions."""

import dataclasses

from starjax.core.learners import Learner
from starjax.core.limits import Positive


@dataclasses.dataclass(frozen=True, kw_only=True)
class ScaledConfig:
    """Options of the learner `scaled`."""

    gain: Positive = 1.0  # at the start


def check(options, policy_config):
    """Raises nothing: its options go with all others."""


def make(options, policy_config, sizes):
    """Returns the model of sequences."""
    import jax
    import jax.numpy as jnp

    from starjax.policies import sequences

    def predict(params, condition):
        flat = sequences.condition_vector(condition) @ params["map"]
        return (params["gain"] * flat).reshape(-1, sizes.horizon, sizes.action)

    def init(key):
        shape = (sizes.condition, sizes.horizon * sizes.action)
        return {"map": 0.01 * jax.random.normal(key, shape), "gain": jnp.asarray(options.gain)}

    def loss(params, condition, x0):
        return jnp.mean((predict(params, condition) - x0) ** 2), {}

    def sample(params, keys, condition, reach):
        low, high = (-1.0, 1.0) if reach is None else reach
        return jnp.clip(predict(params, condition), low, high)

    return sequences.SequenceModel(init, lambda key, x0: x0, loss, sample)


LEARNER = Learner(ScaledConfig, check, make)
