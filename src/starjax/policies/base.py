"""A policy, as training and evaluation know it: a tuple of pure functions."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from starjax import rcm
from starjax.core.types import Command, Observation
from starjax.data import normalizer, windows
from starjax.policies.sequences import Params

__all__ = ["Params", "Policy"]


class Policy(NamedTuple):
    """A policy's pure functions.

    The loss of a batch is `loss(params, prepare(stats, key, batch))`.

    Attributes:
      init: `key -> params`, those that training changes. A vision encoder's are `vision`; of a
        frozen one they are missing, and must be added for `sample` to read images.
      prepare: `(stats, key, batch) -> prepared`, all that is random and needs no parameters: a
        pytree of arrays whose leading axis is the batch.
      loss: `(params, prepared) -> (scalar, {name: scalar})`, the names being `metrics`: means over
        the batch.
      sample: `(params, stats, keys [B], Observation [B, O, A], trocar [B, A]) -> Command
        [B, H, A]`, always finite. Sample i depends on `keys[i]` alone; `trocar` is measured.
      metrics: names of the metrics that `loss` returns.
      cast_params: `params -> params` with large matrices in the networks' dtype.
      prepare_for_inference: `params -> params` in the form that `sample` uses fastest, for
        inference only.
      generate: the learner's part of `sample`, with the same arguments -> normalised actions
        `[B, H, D]`; within the limits only with a further argument True.
      execute: the rest, `(params, stats, actions, observation, trocar) -> Command [B, H, A]`.
    """

    init: Callable[[jax.Array], Params]
    prepare: Callable[[normalizer.Normalizer, jax.Array, windows.Batch], Any]
    loss: Callable[[Params, Any], tuple[jax.Array, dict[str, jax.Array]]]
    sample: Callable[
        [Params, normalizer.Normalizer, jax.Array, Observation, rcm.TrocarFrame],
        Command,
    ]
    metrics: tuple[str, ...] = ()
    cast_params: Callable[[Params], Params] = lambda params: params
    prepare_for_inference: Callable[[Params], Params] = lambda params: params
    generate: Callable[..., jax.Array] | None = None
    execute: Callable[..., Command] | None = None
