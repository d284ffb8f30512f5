"""Values of simulator states: the expected discounted reward, the baseline of advantages.

Its inputs include more than the policy observes, such as the objects' poses and the trocar.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax

from starjax.core.types import ArrayTree
from starjax.policies.models import layers
from starjax.sim.state import Env, EnvState

WIDTH, LAYERS = 256, 3
RATE = 5e-4  # learning rate


class Critic(NamedTuple):
    """State of the network.

    Attributes:
      params: of `ValueNet`.
      optimizer: its state.
      mean, scale: `[K]` of the inputs of the first iteration.
    """

    params: Any
    optimizer: Any
    mean: jax.Array
    scale: jax.Array


class ValueNet(nn.Module):
    """MLP from standardised inputs to a value."""

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps `[B, K]` to `[B]`."""
        for _ in range(LAYERS):
            x = jnp.tanh(layers.Dense(WIDTH)(x))
        return layers.Dense(1)(x)[..., 0]


_ADAM = optax.adam(RATE)


def inputs(env: Env) -> Callable[[Any], jax.Array]:
    """Makes the function from EnvState `[N]` to the inputs `[N, K]`."""
    task = env.task

    def of_one(state: EnvState) -> jax.Array:
        fields = task.state(env.scene.bound, state.layout, state.measurements)
        parts = (
            fields,
            task.relative(fields, state.pose.p),
            state.pose.p,
            state.pose.R[..., :2],
            state.gripper,
            state.trocar.p_world_trocar,
            state.stage,
            state.reward,
            state.step,
        )
        return jnp.concatenate([jnp.ravel(part).astype(jnp.float32) for part in parts])

    return jax.vmap(of_one)


def begin(key: jax.Array, seen: jax.Array, alive: jax.Array) -> Critic:
    """Returns a new critic for inputs like `seen` `[N, R, K]` at the decisions `alive`."""
    rows = alive[..., None]
    mean = jnp.mean(seen, axis=(0, 1), where=rows)
    scale = jnp.std(seen, axis=(0, 1), where=rows)
    params = ValueNet().init(key, seen[0, :1])
    # Inputs that do not vary, such as the trocar of a single configuration, say nothing.
    return Critic(params, _ADAM.init(params), mean, jnp.where(scale > 1e-6, scale, jnp.inf))


def values(critic: Critic, seen: jax.Array) -> jax.Array:
    """Returns the values of inputs `[..., K]`."""
    return jnp.asarray(ValueNet().apply(critic.params, (seen - critic.mean) / critic.scale))


def step(critic: Critic, seen: jax.Array, returns: jax.Array) -> Critic:
    """Takes one step of the squared error between values of `seen` `[B, K]` and `returns` `[B]`."""

    def loss(params: ArrayTree) -> jax.Array:
        return jnp.mean((values(critic._replace(params=params), seen) - returns) ** 2)

    change, optimizer = _ADAM.update(jax.grad(loss)(critic.params), critic.optimizer)
    return critic._replace(params=optax.apply_updates(critic.params, change), optimizer=optimizer)
