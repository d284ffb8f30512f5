"""One pure training step, and many of them in one compiled call."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh

from starjax import config
from starjax.data import windows
from starjax.policies import policy as policies
from starjax.training import devices
from starjax.training import state as states
from starjax.training.state import TrainState

_SMALL = 1 << 16  # entries: a leaf below takes a GPU longer to start on than to read

Carried = tuple[TrainState, policies.Params | None]


def step_keys(key: jax.Array, step: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Keys of a step: which frames it sees, and its noise."""
    key_frames, key_loss = jax.random.split(jax.random.fold_in(key, step))
    return key_frames, key_loss


def train_step(
    policy: policies.Policy,
    optimizer: optax.GradientTransformation,
    train_config: config.TrainConfig,
    state: TrainState,
    batch: windows.Batch,
    narrow: policies.Params | None = None,
) -> TrainState:
    """One step of AdamW and of the average; left out, and counted, if it is not finite.

    `narrow` are the `rounded` matrices of the state's parameters, if they are at hand.
    """
    _, key_loss = step_keys(state.key, state.step)
    params = state.params
    if narrow is not None:
        params = jax.tree.map(lambda p, n: p if n is None else n, params, narrow)
    (loss, metrics), gradients = jax.value_and_grad(policy.loss, has_aux=True)(
        params, state.normalizer, key_loss, batch
    )
    gradients = jax.tree.map(lambda g, p: g.astype(p.dtype), gradients, state.params)
    norm = _norm(gradients)
    finite = jnp.isfinite(loss) & jnp.isfinite(norm)
    # zeros in place of NaN keep the arithmetic below harmless; its results are dropped
    gradients = jax.tree.map(lambda g: jnp.where(finite, g, 0.0), gradients)
    updates, opt_state = optimizer.update(gradients, state.opt_state, state.params)
    params = optax.apply_updates(state.params, updates)
    decay = states.ema_decay(state.step, train_config.ema_max)
    ema_params = optax.incremental_update(params, state.ema_params, 1.0 - decay)

    said = {"loss": loss, "gradient_norm": norm, **metrics}
    sums = {name: state.sums[name] + jnp.where(finite, said[name], 0.0) for name in said}
    sums["taken"] = state.sums["taken"] + jnp.where(finite, 1.0, 0.0)
    sums["skipped"] = state.sums["skipped"] + jnp.where(finite, 0.0, 1.0)

    def keep(new, old):
        return jax.tree.map(functools.partial(jax.lax.select, finite), new, old)

    return state.replace(
        step=state.step + 1,
        params=keep(params, state.params),
        ema_params=keep(ema_params, state.ema_params),
        opt_state=keep(opt_state, state.opt_state),
        skipped=state.skipped + jnp.where(finite, 0, 1),
        sums=sums,
    )


def resident_step(
    policy: policies.Policy,
    optimizer: optax.GradientTransformation,
    policy_config: config.PolicyConfig,
    train_config: config.TrainConfig,
    mesh: Mesh,
    state: TrainState,
    dataset: windows.Dataset,
    frames: jax.Array,
    narrow: policies.Params | None = None,
) -> TrainState:
    """One step on a dataset that is on the device.

    Args:
      policy: to be trained.
      optimizer: from `state.make_optimizer`.
      policy_config: the horizons of a window.
      train_config: batch size and averaging.
      mesh: the batch is split over it.
      state: donated by the caller.
      dataset: leaves are jax arrays, on every device of the mesh.
      frames: `[n]` int32 frames to draw from.
      narrow: see `train_step`.
    """
    key_frames, _ = step_keys(state.key, state.step)
    frame = windows.sample_frames(key_frames, frames, train_config.batch_size)
    frame = jax.lax.with_sharding_constraint(frame, devices.batch_sharding(mesh))
    batch = windows.gather(dataset, frame, policy_config.obs_horizon, policy_config.horizon)
    return train_step(policy, optimizer, train_config, state, batch, narrow)


def carried_step(
    policy: policies.Policy,
    optimizer: optax.GradientTransformation,
    policy_config: config.PolicyConfig,
    train_config: config.TrainConfig,
    mesh: Mesh,
    carried: Carried,
    dataset: windows.Dataset,
    frames: jax.Array,
) -> Carried:
    """`resident_step` of a state and its `rounded` matrices: the optimiser writes both, so that
    the float32 ones are not read again to round them."""
    settings = (policy, optimizer, policy_config, train_config, mesh)
    state = resident_step(*settings, carried[0], dataset, frames, carried[1])
    return state, rounded(state.params, policy_config.dtype)


def rounded(params: policies.Params, dtype: str) -> policies.Params:
    """The matrices that `policy.rounded` changes, as it gives them; None in the others' places."""
    changed = policies.rounded(params, dtype)
    return jax.tree.map(lambda old, new: None if new.dtype == old.dtype else new, params, changed)


def resident_steps(
    policy: policies.Policy,
    optimizer: optax.GradientTransformation,
    policy_config: config.PolicyConfig,
    train_config: config.TrainConfig,
    mesh: Mesh,
    state: TrainState,
    dataset: windows.Dataset,
    frames: jax.Array,
    count: jax.Array,
) -> TrainState:
    """`count` times `resident_step`, in one program for any count.

    `count`, int32 `[]`, is a traced number, so that logging and checkpoints may stop anywhere
    without another compilation.
    """
    settings = (policy, optimizer, policy_config, train_config, mesh)
    first = state, rounded(state.params, policy_config.dtype)
    return jax.lax.fori_loop(
        0, count, lambda _, carried: carried_step(*settings, carried, dataset, frames), first
    )[0]


def _norm(tree: Any) -> jax.Array:
    """Euclidean norm of all leaves. The small ones are summed up together: on a GPU a kernel or
    two for each take longer than all the large ones."""
    leaves = jax.tree.leaves(tree)
    small = [leaf.ravel() for leaf in leaves if leaf.size < _SMALL]
    large = [leaf for leaf in leaves if leaf.size >= _SMALL]
    together = [jnp.concatenate(small)] if small else []
    return jnp.sqrt(jnp.stack([jnp.sum(leaf * leaf) for leaf in large + together]).sum())


def runs_in_a_loop(policy_config: config.PolicyConfig) -> bool:
    """Whether many steps in one program are faster than a program for each: not with pictures.

    XLA's CPU compiler gives convolutions the layout that its fast kernels need only outside of
    loops; inside, those of the gradient run 12 times slower. On a GPU a loop asks the host after
    each step whether to go on, and then waits for it, while calls are handed over ahead of time.
    """
    return policy_config.observation != "image" or policy_config.freeze_encoder
