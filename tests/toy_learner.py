"""A learner from outside the package: the sequence is a linear map of the condition."""

import dataclasses
from typing import Annotated

from starjax.core import errors
from starjax.core.learners import Learner
from starjax.core.limits import Range


@dataclasses.dataclass(frozen=True, kw_only=True)
class ToyConfig:
    """Options of the learner `toy`."""

    gain: Annotated[float, Range(0.0, 10.0)] = 1.0  # weights of the map
    time_dim: int = 8  # not used; other learners have it too


def check(options, policy_config):
    """Raises UsageError for a gain that the horizon does not bear."""
    if options.gain > policy_config.horizon:
        raise errors.UsageError("policy.gain", "at most policy.horizon", options.gain)


def make(options, policy_config, sizes):
    """The model; jax is imported here, as `--help` does without."""
    import jax
    import jax.numpy as jnp

    from starjax.policies import sequences

    shape = (sizes.horizon, sizes.action)

    def said(params, condition):
        flat = options.gain * sequences.condition_vector(condition) @ params["map"] + params["bias"]
        return flat.reshape(-1, *shape)

    def init(key):
        width = sizes.horizon * sizes.action
        drawn = jax.random.normal(key, (sizes.condition, width))
        return {"map": 0.01 * drawn, "bias": jnp.zeros(width)}

    def loss(params, condition, x0):
        error = jnp.abs(said(params, condition) - x0)
        return jnp.mean(error), {"worst": jnp.max(error)}

    def sample(params, keys, condition, reach):
        low, high = (-1.0, 1.0) if reach is None else reach
        return jnp.clip(said(params, condition), low, high)

    return sequences.SequenceModel(init, lambda key, x0: x0, loss, sample, metrics=("worst",))


TOY = Learner(ToyConfig, check, make)
