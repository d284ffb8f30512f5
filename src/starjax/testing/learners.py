"""Checks of a learner: options, and shapes, gradients and draws of a small model of it."""

import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from starjax.cli import presets
from starjax.core import config
from starjax.core.learners import LEARNERS
from starjax.policies import learner_contract
from starjax.policies.sequences import Condition, Params, SequenceModel, Sizes
from starjax.testing.base import Check, attempt, failed, verdict

CONDITIONS = 4
# Sequences of each condition, with the same keys: samples of a generator differ by more than a
# short training moves them.
COPIES = 8
BATCH = CONDITIONS * COPIES
# With and without images and a trocar.
SIZES = {
    "of the state": Sizes(horizon=16, action=5, obs_horizon=2, vision=0, state=8, trocar=0),
    "of images": Sizes(horizon=16, action=10, obs_horizon=2, vision=12, state=8, trocar=7),
}
STEPS = 300  # steps of a short training
LEARNING_RATE = 1e-3
TARGET = 0.5  # amplitude of a learned sequence, of either sign: the condition says which
NEARER = 0.02  # fraction of the mean action's error by which the samples' must be smaller
# Share by which samples may follow another action, or time, more than their own.
MISPLACED = 0.1
SEEN = 1e-6  # least change of a sample
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
    small = presets.PRESETS["smoke"].policy  # its options are those of a small network
    policy = config.with_learner(small, name)
    LEARNERS.get(name).check(policy.options, policy)
    return policy


def _values(text: str, model: SequenceModel, sizes: Sizes) -> Iterator[Check]:
    """Yields checks of numbers: loss, gradients, samples, and a short training with images."""
    params = jax.jit(model.init)(jax.random.key(0))
    distinct = learner_contract.condition(sizes, CONDITIONS, jax.random.key(1))
    condition = jax.tree.map(lambda x: jnp.repeat(x, COPIES, 0), distinct)
    x0 = jax.random.uniform(jax.random.key(2), (BATCH, sizes.horizon, sizes.action), minval=-1)
    prepare, sample = jax.jit(model.prepare), jax.jit(model.sample)
    learned = jax.jit(
        jax.value_and_grad(lambda params, given: model.loss(params, condition, given)[0])
    )
    loss, gradient = learned(params, prepare(jax.random.key(3), x0))
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
    keys = jnp.tile(jax.random.split(jax.random.key(4), COPIES), CONDITIONS)

    def drawn(params: Params, condition: Condition) -> np.ndarray:
        return np.asarray(sample(model.prepare_for_inference(params), keys, condition, None))

    yield verdict(
        f"samples, {text}", _samples(model, sample, params, condition, keys), "follow their keys"
    )
    if not sizes.vision or not np.isfinite(loss) or faults:
        return
    sides = jnp.where(jnp.arange(BATCH) // COPIES % 2, 1.0, -1.0)[:, None, None]
    waves = _waves(sizes.horizon, sizes.action)
    target = TARGET * sides * waves
    given = [prepare(key, target) for key in jax.random.split(jax.random.key(5), STEPS)]
    trained, losses = _trained(learned, params, given)
    other = float(learned(trained, prepare(jax.random.key(5), -target))[0])
    own = float(learned(trained, prepare(jax.random.key(5), target))[0])
    shape = (drawn(trained, condition) * np.asarray(sides)).mean(0) / TARGET
    error = abs(1.0 - float((shape * waves).sum() / (waves**2).sum()))
    figures = f"samples have {error:.2f} of the mean action's error after {STEPS} steps"
    faults = list(_unlearned(losses, error))
    if not other > own:
        faults.append(f"the loss is {own:.3g} for learned sequences and {other:.3g} for others")
    value = jax.jit(lambda x: model.loss(params, condition, model.prepare(keys[0], x))[0])
    faults += [*_ignored(value, x0), *_misplaced(shape, waves)]
    yield verdict(f"training, {text}", faults, figures)
    blind = _blind(functools.partial(drawn, trained), condition)
    yield verdict(f"input, {text}", blind, "samples follow it")


def _waves(horizon: int, actions: int) -> np.ndarray:
    """Returns orthogonal sequences `[H, D]`, a cosine per action; half change sign in reverse."""
    steps = np.arange(horizon)[:, None] + 0.5
    return np.cos(np.pi * steps * np.arange(1, actions + 1) / horizon)


def _misplaced(shape: np.ndarray, waves: np.ndarray) -> Iterator[str]:
    """Yields faults of mean samples `[H, D]` that follow `waves` `[H, D]` in another order."""

    def follows(waves: np.ndarray) -> np.ndarray:
        """Returns `[D, D]`, the share of each wave in each action of the samples."""
        return 2.0 / len(waves) * waves.T @ shape

    shares = follows(waves)
    own, back = np.diagonal(shares), np.diagonal(follows(waves[::-1]))
    if (back - own).max() > MISPLACED:
        text = f"{back.mean():.2f} reversed in time, by {own.mean():.2f} in order"
        yield f"samples follow learned sequences by {text}"
        return
    for i in np.flatnonzero(shares.max(0) - own > MISPLACED):
        other = shares[:, i].argmax()
        text = f"{shares[other, i]:.2f}, its own one by {own[i]:.2f}"
        yield f"action {i} of samples follows the learned action {other} by {text}"


def _trained(
    learned: Callable[..., Any], params: Params, given: Sequence[Any]
) -> tuple[Any, np.ndarray]:
    """Returns parameters after a short training, and the losses of its steps."""
    optimiser = optax.adam(LEARNING_RATE)

    @jax.jit
    def update(params: Params, state: optax.OptState, gradient: Params) -> tuple[Any, Any]:
        updates, state = optimiser.update(gradient, state, params)
        return optax.apply_updates(params, updates), state

    state, losses = optimiser.init(params), []
    for each in given:
        loss, gradient = learned(params, each)
        params, state = update(params, state, gradient)
        losses.append(float(loss))
    return params, np.array(losses)


def _unlearned(losses: np.ndarray, error: float) -> Iterator[str]:
    """Yields faults of a training: the loss does not fall, or samples are no better than a mean.

    Args:
      losses: of the steps.
      error: of the samples, as a fraction of that of the demonstrations' mean action.
    """
    tenth = len(losses) // 10
    first, last = losses[:tenth].mean(), losses[-tenth:].mean()
    if not last < first:
        yield f"the loss goes from {first:.3g} to {last:.3g} in {STEPS} steps"
    if not error < 1.0 - NEARER:
        text = f"{error:.2f} of the mean action's, expected below {1.0 - NEARER:.2f}"
        yield f"the samples' error after {STEPS} steps is {text}"


def _ignored(loss: Callable[[jax.Array], jax.Array], x0: jax.Array) -> Iterator[str]:
    """Yields the steps and actions of sequences `[B, H, D]` that a loss ignores."""
    own = float(loss(x0))
    for axis, name in ((1, "steps"), (2, "actions")):
        sizes = [x0.shape[axis] if i == axis else 1 for i in range(x0.ndim)]
        each = jnp.eye(x0.shape[axis]).reshape(-1, *sizes)
        if same := [i for i, change in enumerate(each) if float(loss(x0 + change)) == own]:
            yield f"the loss ignores {name} {', '.join(map(str, same))}"


def _blind(drawn: Callable[[Condition], np.ndarray], condition: Condition) -> Iterator[str]:
    """Yields the parts of a condition that no sample follows."""
    before = drawn(condition)
    for name, part in condition._asdict().items():
        if part is not None and part.size:
            moved = float(np.abs(drawn(condition._replace(**{name: part + 1.0})) - before).max())
            if moved < SEEN:
                yield f"other {name} changes samples by {moved:.2g}, expected {SEEN:g} or more"


def _samples(
    model: SequenceModel,
    sample: Callable[..., jax.Array],
    params: Params,
    condition: Condition,
    keys: jax.Array,
) -> Iterator[str]:
    ready = model.prepare_for_inference(params)
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
