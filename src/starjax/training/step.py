"""One pure training step, and many of them in one compiled call."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import optax

from starjax import config
from starjax.data import windows
from starjax.policies.base import Policy
from starjax.training import devices
from starjax.training import state as states
from starjax.training.sharding import Carried, Parts


def step_keys(key: jax.Array, step: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Keys of a step: which frames it sees, and its noise."""
    key_frames, key_loss = jax.random.split(jax.random.fold_in(key, step))
    return key_frames, key_loss


def train_step(
    policy: Policy,
    optimizer: optax.GradientTransformation,
    train_config: config.TrainConfig,
    parts: Parts,
    carried: Carried,
    batch: windows.Batch,
) -> Carried:
    """One step of AdamW and of the average; left out, and counted, if it is not finite."""
    state, _ = carried
    _, key_loss = step_keys(state.key, state.step)
    given = policy.prepare(state.normalizer, key_loss, batch)
    update = functools.partial(_update, policy, optimizer, train_config, parts)
    return parts.on_each(update)(carried, given)


def _update(
    policy: Policy,
    optimizer: optax.GradientTransformation,
    train_config: config.TrainConfig,
    parts: Parts,
    carried: Carried,
    given: Any,
) -> Carried:
    """What each device does with its share of a prepared batch."""
    state, _ = carried
    (loss, metrics), gradients = jax.value_and_grad(
        lambda params: policy.loss(parts.whole(params), given), has_aux=True
    )(parts.params(carried))
    said = parts.mean({"loss": loss, **metrics})
    gradients = parts.mean_gradient(gradients)
    norm = parts.norm(gradients)
    finite = jnp.isfinite(said["loss"]) & jnp.isfinite(norm)
    # zeros in place of NaN keep the arithmetic below harmless; its results are dropped
    gradients = jax.tree.map(lambda g: jnp.where(finite, g, 0.0), gradients)
    updates, opt_state = optimizer.update(gradients, state.opt_state, state.params)
    params = optax.apply_updates(state.params, updates)
    decay = states.ema_decay(state.step, train_config.ema_max)
    ema_params = optax.incremental_update(params, state.ema_params, 1.0 - decay)

    said["gradient_norm"] = norm
    sums = {name: state.sums[name] + jnp.where(finite, said[name], 0.0) for name in said}
    sums["taken"] = state.sums["taken"] + jnp.where(finite, 1.0, 0.0)
    sums["skipped"] = state.sums["skipped"] + jnp.where(finite, 0.0, 1.0)

    def keep(new, old):
        return jax.tree.map(functools.partial(jax.lax.select, finite), new, old)

    state = state.replace(
        step=state.step + 1,
        params=keep(params, state.params),
        ema_params=keep(ema_params, state.ema_params),
        opt_state=keep(opt_state, state.opt_state),
        skipped=state.skipped + jnp.where(finite, 0, 1),
        sums=sums,
    )
    return state, parts.rounded(state.params)


def resident_step(
    policy: Policy,
    optimizer: optax.GradientTransformation,
    policy_config: config.PolicyConfig,
    train_config: config.TrainConfig,
    parts: Parts,
    carried: Carried,
    dataset: windows.Dataset,
    frames: jax.Array,
) -> Carried:
    """One step on a dataset that is on the device.

    Args:
      policy: to be trained.
      optimizer: from `state.make_optimizer`.
      policy_config: the horizons of a window.
      train_config: batch size and averaging.
      parts: of the devices over which the batch is split.
      carried: from `parts.begin` or the step before; donated by the caller.
      dataset: leaves are jax arrays, on every device of the mesh.
      frames: `[n]` int32 frames to draw from.
    """
    state, _ = carried
    key_frames, _ = step_keys(state.key, state.step)
    frame = windows.sample_frames(key_frames, frames, train_config.batch_size)
    frame = jax.lax.with_sharding_constraint(frame, devices.batch_sharding(parts.mesh))
    batch = windows.gather(dataset, frame, policy_config.obs_horizon, policy_config.horizon)
    return train_step(policy, optimizer, train_config, parts, carried, batch)


def resident_steps(
    policy: Policy,
    optimizer: optax.GradientTransformation,
    policy_config: config.PolicyConfig,
    train_config: config.TrainConfig,
    parts: Parts,
    carried: Carried,
    dataset: windows.Dataset,
    frames: jax.Array,
    count: jax.Array,
) -> Carried:
    """`count` times `resident_step`, in one program for any count.

    `count`, int32 `[]`, is a traced number, so that logging and checkpoints may stop anywhere
    without another compilation.
    """
    settings = (policy, optimizer, policy_config, train_config, parts)
    return jax.lax.fori_loop(
        0, count, lambda _, carried: resident_step(*settings, carried, dataset, frames), carried
    )


def runs_in_a_loop(policy_config: config.PolicyConfig) -> bool:
    """Whether many steps in one program are faster than a program for each: not with pictures.

    XLA's CPU compiler gives convolutions the layout that its fast kernels need only outside of
    loops; inside, those of the gradient run 12 times slower. On a GPU a loop asks the host after
    each step whether to go on, and then waits for it, while calls are handed over ahead of time.
    """
    return policy_config.observation != "image" or policy_config.freeze_encoder
