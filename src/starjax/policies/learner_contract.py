"""Results that a learner's model must return, checked by tracing before it is trained."""

import functools
from typing import Any

import jax
import jax.numpy as jnp

from starjax.core import config, errors
from starjax.core.learners import LEARNERS
from starjax.policies.sequences import Condition, SequenceModel, Sizes
from starjax.runtime import user_code

BATCH = 2


def make(policy: config.PolicyConfig, sizes: Sizes) -> SequenceModel:
    """Returns the model of the settings' learner; that of another package is checked.

    Raises:
      errors.UsageError: names the learner's function and its place.
    """
    learner, part = LEARNERS.get(policy.learner), f"learner {policy.learner}"
    if policy.learner in LEARNERS.built_in:
        return learner.make(policy.options, policy, sizes)
    model = user_code.guarded(part, "make", learner.make)(policy.options, policy, sizes)
    if not isinstance(model, SequenceModel):
        raise errors.UsageError(f"{part}: make", "a SequenceModel", type(model).__name__)
    check(part, model, sizes)
    return model


def check(part: str, model: SequenceModel, sizes: Sizes) -> None:
    """Traces a model's functions; raises errors.UsageError for the first wrong result."""
    calls = {
        name: user_code.guarded(part, name, getattr(model, name))
        for name in ("init", "prepare", "loss", "sample", "cast_params", "prepare_for_inference")
    }

    def refuse(name: str, expected: str, got: Any) -> None:
        subject = user_code.subject(part, name, getattr(model, name))
        raise errors.UsageError(subject, expected, got)

    trace = jax.eval_shape
    key, keys = jax.random.key(0), jax.random.split(jax.random.key(0), BATCH)
    shape = (BATCH, sizes.horizon, sizes.action)
    params = trace(calls["init"], key)
    if not isinstance(params, dict):
        refuse("init", "a dict of parameters", type(params).__name__)
    given = trace(calls["prepare"], key, jnp.zeros(shape))
    for leaf in jax.tree.leaves(given):
        if leaf.shape[:1] != (BATCH,):
            refuse("prepare", f"a leading axis of {BATCH}, the batch", list(leaf.shape))
    inputs = condition(sizes, BATCH, key)
    result = trace(calls["loss"], trace(calls["cast_params"], params), inputs, given)
    if not isinstance(result, tuple) or len(result) != 2 or not isinstance(result[1], dict):
        refuse("loss", "a scalar and a dict of metrics", type(result).__name__)
    if result[0].shape != ():
        refuse("loss", "a scalar", list(result[0].shape))
    if set(result[1]) != set(model.metrics):
        names = ", ".join(result[1]) or "none"
        refuse("loss", f"the metrics {', '.join(model.metrics) or 'none'}", names)
    ready = trace(calls["prepare_for_inference"], params)
    drawn = trace(functools.partial(calls["sample"], reach=None), ready, keys, inputs)
    if getattr(drawn, "shape", None) != shape:
        got = list(drawn.shape) if hasattr(drawn, "shape") else type(drawn).__name__
        refuse("sample", f"{list(shape)}: keys, horizon, action", got)
    if drawn.dtype != jnp.float32:
        refuse("sample", "float32", drawn.dtype)


def condition(sizes: Sizes, batch: int, key: jax.Array) -> Condition:
    """Returns a random condition of these sizes."""
    draw = functools.partial(jax.random.normal, key)
    vision = draw((batch, sizes.obs_horizon, sizes.vision)) if sizes.vision else None
    return Condition(vision, draw((batch, sizes.state)), draw((batch, sizes.trocar)))
