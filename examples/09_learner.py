"""Defines a learner: regression to the demonstrated sequence, in place of diffusion.

`make` returns a model of sequences of normalised actions as pure functions. In a package of your
own the entry point `starjax.learners` makes it `--policy.learner regression` of every method.
"""

import dataclasses

from starjax.core.learners import Learner
from starjax.core.limits import Count


@dataclasses.dataclass(frozen=True, kw_only=True)
class RegressionConfig:
    """Options of the learner `regression`."""

    width: Count = 512  # of the hidden layer


def check(options, policy_config):
    """Raises errors.UsageError for incompatible options; every combination works here."""


def make(options, policy_config, sizes):
    """Returns the model of sequences."""
    import flax.linen as nn  # imported here: `--help` reads this module, without jax
    import jax.numpy as jnp

    from starjax.policies import sequences

    layers = [nn.Dense(options.width), nn.gelu, nn.Dense(sizes.horizon * sizes.action)]
    network = nn.Sequential(layers)

    def init(key):
        return network.init(key, jnp.zeros((1, sizes.condition)))

    def predict(params, condition):
        flat = network.apply(params, sequences.condition_vector(condition))
        return flat.reshape(-1, sizes.horizon, sizes.action)

    def prepare(key, x0):
        return x0  # the loss's random numbers are drawn here; this one needs none

    def loss(params, condition, x0):
        return jnp.mean((predict(params, condition) - x0) ** 2), {}

    def sample(params, keys, condition, reach):
        low, high = (-1.0, 1.0) if reach is None else reach
        return jnp.clip(predict(params, condition), low, high)

    return sequences.SequenceModel(init, prepare, loss, sample)


LEARNER = Learner(RegressionConfig, check, make)


def main() -> None:
    import jax
    import jax.numpy as jnp
    import optax

    from starjax.core import config
    from starjax.policies import sequences

    sizes = sequences.Sizes(horizon=16, action=4, obs_horizon=2, vision=0, state=8, trocar=7)
    model = LEARNER.make(RegressionConfig(width=32), config.PolicyConfig(), sizes)
    key_params, key_state, key_sample = jax.random.split(jax.random.key(0), 3)
    condition = sequences.Condition(None, jax.random.normal(key_state, (64, 8)), jnp.ones((64, 7)))
    x0 = jnp.tanh(condition.state[:, None, :4]) * jnp.linspace(0.0, 1.0, 16)[:, None]
    params = model.init(key_params)
    optimiser = optax.adam(3e-3)
    state = optimiser.init(params)

    @jax.jit
    def train_step(params, state):
        (loss, _), grads = jax.value_and_grad(model.loss, has_aux=True)(params, condition, x0)
        updates, state = optimiser.update(grads, state)
        return optax.apply_updates(params, updates), state, loss

    losses = []
    for _ in range(300):
        params, state, loss = train_step(params, state)
        losses.append(float(loss))
    plan = model.sample(params, jax.random.split(key_sample, 64), condition, None)
    print(f"loss {losses[0]:.3f} to {losses[-1]:.4f}; plans {plan.shape}")


if __name__ == "__main__":
    main()
