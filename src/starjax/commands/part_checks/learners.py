"""Checks of a learner: options, and shapes, gradients and draws of a small model of it."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from starjax import config
from starjax.commands.part_checks.base import Check, attempt, failed, verdict
from starjax.learners import LEARNERS
from starjax.policies import learner_contract
from starjax.policies.sequences import Condition, SequenceModel, Sizes

BATCH = 3
# With and without images and a trocar.
SIZES = {
    "of the state": Sizes(horizon=16, action=5, obs_horizon=2, vision=0, state=8, trocar=0),
    "of images": Sizes(horizon=16, action=10, obs_horizon=2, vision=12, state=8, trocar=7),
}
TOLERANCE = 1e-4  # between a sample in one batch and in another


def check(name: str, n: int) -> Iterator[Check]:
    """Yields the checks of a learner with its default options; `n` is not used."""
    fault, policy = attempt("options", lambda: _settings(name))
    if fault:
        yield fault
        return
    yield Check("options", ", ".join(vars(policy.options)) or "none")
    for text, sizes in SIZES.items():
        fault, model = attempt(text, lambda s=sizes: learner_contract.make(policy, s))
        yield fault or Check(f"shapes, {text}", "of init, loss and sample")
        if not fault:
            yield from _values(text, model, sizes)


def _settings(name: str) -> config.PolicyConfig:
    policy = config.PolicyConfig(learner=name)
    LEARNERS.get(name).check(policy.options, policy)
    return policy


def _values(text: str, model: SequenceModel, sizes: Sizes) -> Iterator[Check]:
    """Yields checks of numbers: loss, gradients, samples."""
    params = jax.jit(model.init)(jax.random.key(0))
    condition = learner_contract.condition(sizes, BATCH, jax.random.key(1))
    x0 = jax.random.uniform(jax.random.key(2), (BATCH, sizes.horizon, sizes.action), minval=-1)
    given = model.prepare(jax.random.key(3), x0)
    learned = jax.value_and_grad(lambda p: model.loss(p, condition, given)[0])
    loss, gradient = jax.jit(learned)(params)
    still = [
        jax.tree_util.keystr(path)
        for path, leaf in jax.tree_util.tree_leaves_with_path(gradient)
        if not np.isfinite(leaf).all()
    ]
    if not np.isfinite(loss):
        yield failed(f"loss, {text}", f"not finite: {loss}")
    flat = all(not np.any(leaf) for leaf in jax.tree.leaves(gradient))
    faults = [f"not finite at {path}" for path in still] + ["0 everywhere"] * flat
    yield verdict(f"gradient, {text}", faults, f"finite, of a loss of {float(loss):.3g}")
    yield verdict(f"samples, {text}", _samples(model, params, condition), "follow their keys")


def _samples(model: SequenceModel, params: Any, condition: Condition) -> Iterator[str]:
    ready = model.prepare_for_inference(params)
    keys = jax.random.split(jax.random.key(4), BATCH)
    sample = jax.jit(model.sample)
    first = np.asarray(sample(ready, keys, condition, None))
    if not np.isfinite(first).all():
        yield "not finite"
        return
    if np.abs(first).max() > 1.0:
        yield f"expected within [-1, 1] without a reach, got {np.abs(first).max():.3g}"
    reach = jnp.stack([jnp.full(first.shape[-1], -0.5), jnp.full(first.shape[-1], 0.5)])
    within = np.abs(np.asarray(sample(ready, keys, condition, reach))).max()
    if within > 0.5:
        yield f"expected within a reach of 0.5, got {within:.3g}"
    turned = jax.tree.map(lambda x: x[::-1], condition)
    other = np.asarray(sample(ready, keys[::-1], turned, None))[::-1]
    if np.abs(other - first).max() > TOLERANCE:
        yield "a sample depends on more than its own key and condition"
