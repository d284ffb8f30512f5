"""Interface of learners: generative models of normalised action sequences."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike

Params = dict[str, Any]

UNLIMITED: Any = (-jnp.inf, jnp.inf)  # a `reach`


class Sizes(NamedTuple):
    """Sizes of a model's arrays.

    Attributes:
      horizon: H, actions of a sequence.
      action: D, numbers of an action.
      obs_horizon: O, that are observed.
      vision: V, numbers that one moment's images become; 0 without images.
      state: d_s, numbers that the low-dimensional history becomes.
      trocar: E, size of the trocar features; may be 0.
    """

    horizon: int
    action: int
    obs_horizon: int
    vision: int
    state: int
    trocar: int

    @property
    def observed(self) -> int:
        """N, numbers of `observation_vector`."""
        return self.obs_horizon * self.vision + self.state

    @property
    def condition(self) -> int:
        """Numbers of `condition_vector`."""
        return self.observed + self.trocar


class Condition(NamedTuple):
    """Condition of generated sequences.

    Attributes:
      vision: `[B, O, V]`, or None without images.
      state: `[B, d_s]` of the low-dimensional history.
      trocar: `[B, E]` features of the trocars.
    """

    vision: jax.Array | None
    state: jax.Array
    trocar: jax.Array


class SequenceModel(NamedTuple):
    """Pure functions of one model of sequences `[B, H, D]`, about [-1, 1].

    Attributes:
      init: `key -> params`.
      prepare: `(key, x0 [B, H, D]) -> given`, what is learned from demonstrated sequences, with
        everything random drawn: a pytree whose leading axis is the batch.
      loss: `(params, Condition, given) -> (scalar, {name: scalar})`, the names being `metrics`.
      sample: `(params, keys [B], Condition, reach) -> [B, H, D]` within `reach` `[2, D]`, lowest
        and highest, or if it is None within [-1, 1]. Sample i depends on `keys[i]` alone.
      cast_params: `params -> params` whose large matrices are in the type that is calculated in.
      prepare_for_inference: `params -> params` as `sample` uses them fastest here.
      metrics: names of the metrics that `loss` returns.
    """

    init: Callable[[jax.Array], Params]
    prepare: Callable[[jax.Array, jax.Array], Any]
    loss: Callable[[Params, Condition, Any], tuple[jax.Array, dict[str, jax.Array]]]
    sample: Callable[[Params, jax.Array, Condition, jax.Array | None], jax.Array]
    cast_params: Callable[[Params], Params] = lambda params: params
    prepare_for_inference: Callable[[Params], Params] = lambda params: params
    metrics: tuple[str, ...] = ()


def observation_vector(condition: Condition) -> jax.Array:
    """Returns the observation `[B, N]`: image features, then the low-dimensional history."""
    if condition.vision is None:
        return condition.state
    flat = condition.vision.reshape(len(condition.vision), -1)
    return jnp.concatenate([flat, condition.state], axis=-1)


def condition_vector(condition: Condition) -> jax.Array:
    """Returns the observation and the trocar features `[B, N + E]`."""
    vector = observation_vector(condition)
    # XLA of jax 0.11 crashes on an empty array that is concatenated under `shard_map`
    return (
        jnp.concatenate([vector, condition.trocar], axis=-1)
        if condition.trocar.shape[-1]
        else vector
    )


def cast_params(params: Params, names: set[str], dtype: DTypeLike) -> Any:
    """Casts the leaves of these names to another dtype.

    Networks cast them anyway, to the same numbers. Casting once avoids reading float32 at each of
    many evaluations.
    """

    def one(path: tuple[Any, ...], leaf: jax.Array) -> Any:
        return leaf.astype(dtype) if getattr(path[-1], "key", None) in names else leaf

    return jax.tree_util.tree_map_with_path(one, params)
