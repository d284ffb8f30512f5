"""One pure training step, and many of them in one compiled call."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from starjax.core import config
from starjax.data import windows
from starjax.policies.base import Policy
from starjax.rcm import arrays
from starjax.training import devices, randomise
from starjax.training import state as states
from starjax.training.metrics import added
from starjax.training.sharding import StateLayout, StepCarry


class Setup(NamedTuple):
    """Constants of a training, used by every step.

    Attributes:
      policy: to be trained.
      optimizer: from `state.make_optimizer`.
      policy_config: the horizons of a window.
      train_config: batch size and averaging.
      layout: of the state on the devices.
    """

    policy: Policy
    optimizer: optax.GradientTransformation
    policy_config: config.PolicyConfig
    train_config: config.TrainConfig
    layout: StateLayout


def resident_steps(
    setup: Setup,
    carry: StepCarry,
    dataset: windows.Dataset,
    frames: jax.Array,
    available: jax.Array,
    count: jax.Array,
) -> StepCarry:
    """Takes `count` steps on a dataset that is on the device, in one program for any count.

    Args:
      setup: of the training.
      carry: from `StateLayout.to_carry` or the step before; donated by the caller.
      dataset: leaves are jax arrays, on every device of the mesh.
      frames: int32 frames to draw from.
      available: int32 `[]`, number of these; the others fill up the array.
      count: int32 `[]`, traced: logging and checkpoints may stop anywhere without another
        compilation.
    """
    return jax.lax.fori_loop(
        0, count, lambda _, carry: resident_step(setup, carry, dataset, frames, available), carry
    )


@arrays.broadcasting
def resident_step(
    setup: Setup,
    carry: StepCarry,
    dataset: windows.Dataset,
    frames: jax.Array,
    available: jax.Array,
) -> StepCarry:
    """Draws a batch and takes one step; see `resident_steps`."""
    batch = drawn_batch(setup, carry.state.key, carry.state.step, dataset, frames, available)
    return train_step(setup, carry, batch)


class Choice(NamedTuple):
    """Draws of a batch of B windows.

    Attributes:
      frame: int32 `[B]`, frames of the windows.
      draws: their disturbances, None without any.
      seen: int32 `[B, O]`, control steps that are observed, None without disturbances.
    """

    frame: jax.Array
    draws: randomise.Draws | None = None
    seen: jax.Array | None = None


def choose(
    setup: Setup,
    key: jax.Array,
    step: jax.Array,
    dataset: windows.Dataset,
    frames: jax.Array,
    available: jax.Array,
) -> Choice:
    """Chooses the windows of a step; `key` and `step` are the state's.

    It reads the places of the episodes only, see `windows.places`.
    """
    count, keys = setup.train_config.batch_size, states.step_keys(key, step)
    frame = windows.sample_frames(keys.batch, frames, count, available)
    levels = randomise.max_levels(setup.train_config)
    if not levels:
        return Choice(frame)
    draws = randomise.draw(levels, keys.loss, count, count // setup.layout.mesh.size)
    at = windows.control_steps(dataset, frame)
    seen = randomise.seen_steps(list(levels), draws, at, setup.policy_config.obs_horizon)
    return Choice(frame, draws, seen)


def drawn_batch(
    setup: Setup,
    key: jax.Array,
    step: jax.Array,
    dataset: windows.Dataset,
    frames: jax.Array,
    available: jax.Array,
    displaced: Any = None,
) -> windows.Batch:
    """Returns the batch of a step, split over the devices; `key` and `step` are the state's.

    `displaced` is `redrawing.Displaced` if cameras are.
    """
    policy_config = setup.policy_config
    choice = choose(setup, key, step, dataset, frames, available)
    split = devices.batch_sharding(setup.layout.mesh)
    choice = jax.tree.map(lambda x: jax.lax.with_sharding_constraint(x, split), choice)
    batch = windows.gather(
        dataset, choice.frame, policy_config.obs_horizon, policy_config.horizon, choice.seen
    )
    return disturbed(setup, choice, batch, displaced)


def disturbed(
    setup: Setup, choice: Choice, batch: windows.Batch, displaced: Any = None
) -> windows.Batch:
    """Disturbs the images of a gathered batch."""
    if choice.draws is None:
        return batch
    if displaced is not None:
        displaced = jax.tree.map(lambda x: x[:, displaced.index], displaced.images)
    names = list(randomise.max_levels(setup.train_config))

    def change(draws: Any, seen: Any, observation: Any, displaced: Any) -> Any:
        if displaced is not None:
            images = {
                name: randomise.with_first(image, displaced[name])
                for name, image in observation.images.items()
            }
            observation = observation._replace(images=images)
        return randomise.disturb(names, draws, seen, observation)

    change = devices.on_shares(change, setup.layout.mesh)
    observation = change(choice.draws, choice.seen, batch.observation, displaced)
    return batch.replace(observation=observation)


@arrays.broadcasting  # which optax relies on
def train_step(setup: Setup, carry: StepCarry, batch: windows.Batch) -> StepCarry:
    """Takes one step of AdamW and of the average; leaves it out, and counts it, if not finite."""
    key = states.step_keys(carry.state.key, carry.state.step).loss
    prepared = setup.policy.prepare(carry.state.normalizer, key, batch)
    update = functools.partial(_update, setup)
    return setup.layout.on_each_device(update)(carry, prepared)


def _update(setup: Setup, carry: StepCarry, prepared: Any) -> StepCarry:
    """Takes one step on a device's share of a prepared batch."""
    layout, state = setup.layout, carry.state
    # 1. Gradient of the batch, whose shares the devices average.
    (loss, metrics), gradients = jax.value_and_grad(
        lambda params: setup.policy.loss(layout.gather_params(params), prepared), has_aux=True
    )(layout.params(carry))
    metrics = layout.mean({"loss": loss, **metrics})
    gradients = layout.mean_gradients(gradients)
    norm = layout.norm(gradients)
    finite = jnp.isfinite(metrics["loss"]) & jnp.isfinite(norm)
    # zeros instead of NaN keep the arithmetic below harmless; its results are dropped
    gradients = jax.tree.map(lambda g: jnp.where(finite, g, 0.0), gradients)
    updates, opt_state = setup.optimizer.update(gradients, state.opt_state, state.params)
    params = optax.apply_updates(state.params, updates)
    decay = states.ema_decay(state.step, setup.train_config.ema_max)
    ema_params = optax.incremental_update(params, state.ema_params, 1.0 - decay)

    metrics["gradient_norm"] = norm
    sums = added(state.sums, metrics, finite)

    def keep(new: Any, old: Any) -> Any:
        return jax.tree.map(functools.partial(jax.lax.select, finite), new, old)

    state = state.replace(
        step=state.step + 1,
        params=keep(params, state.params),
        ema_params=keep(ema_params, state.ema_params),
        opt_state=keep(opt_state, state.opt_state),
        skipped=state.skipped + jnp.where(finite, 0, 1),
        sums=sums,
    )
    return StepCarry(state, layout.rounded(state.params))


def runs_in_a_loop(policy_config: config.PolicyConfig) -> bool:
    """Returns whether a loop of steps in one program is faster than one program per step.

    Not with images. XLA's CPU compiler gives convolutions the layout that its fast kernels need
    only outside of loops; inside, those of the gradient run 12 times slower. On a GPU a loop
    synchronises with the host after each step, while single calls are dispatched ahead of time.
    """
    return policy_config.observation != "image" or policy_config.freeze_encoder
