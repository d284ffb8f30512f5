"""One pure training step, many of them in one compiled call, and their programs."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from starjax.core import config
from starjax.core.types import Tree
from starjax.data import windows
from starjax.rcm import arrays
from starjax.runtime.precompile import Program
from starjax.training import batches, devices
from starjax.training import state as states
from starjax.training.sharding import Setup, StateLayout, StepCarry


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
    # The count is traced: a loop of any length is the same program.
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
    batch = batches.drawn_batch(
        setup, carry.state.key, carry.state.step, dataset, frames, available
    )
    return train_step(setup, carry, batch)


@arrays.broadcasting  # which optax relies on
def train_step(setup: Setup, carry: StepCarry, batch: windows.Batch) -> StepCarry:
    """Takes one step of AdamW and of the average; leaves it out, and counts it, if not finite."""
    key = states.step_keys(carry.state.key, carry.state.step).loss
    prepared = setup.policy.prepare(carry.state.normalizer, key, batch)
    update = functools.partial(_update, setup)
    return setup.layout.on_each_device(update)(carry, prepared)


def _update(setup: Setup, carry: StepCarry, prepared: windows.Batch) -> StepCarry:
    """Takes one step on a device's share of a prepared batch."""
    layout, state = setup.layout, carry.state
    # 1. Gradient of the batch, whose shares the devices average.
    # L of Eq. 15 for the paper's method.
    (loss, metrics), gradients = jax.value_and_grad(
        lambda params: setup.policy.loss(layout.gather_params(params), prepared), has_aux=True
    )(layout.params(carry))
    metrics = layout.mean({"loss": loss, **metrics})
    gradients = layout.mean_gradients(gradients)
    norm = layout.norm(gradients)
    finite = jnp.isfinite(metrics["loss"]) & jnp.isfinite(norm)
    # zeros instead of NaN keep the arithmetic below harmless; its results are dropped
    gradients = jax.tree.map(lambda g: jnp.where(finite, g, 0.0), gradients)
    # 2. AdamW
    updates, opt_state = setup.optimizer.update(gradients, state.opt_state, state.params)
    params = optax.apply_updates(state.params, updates)
    decay = states.ema_decay(state.step, setup.train_config.ema_max)
    # 3. theta_ema <- decay theta_ema + (1 - decay) theta: the weights that act.
    ema_params = optax.incremental_update(params, state.ema_params, 1.0 - decay)

    metrics["gradient_norm"] = norm
    sums = states.add_metrics(state.sums, metrics, finite)

    def keep(new: Tree, old: Tree) -> Tree:
        # Selected leaf by leaf, without a branch: a condition would copy the whole state.
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


def batch_program(setup: Setup) -> Program:
    """Returns the program of one step on a batch: (StepCarry, Batch) -> StepCarry."""
    return _program(functools.partial(train_step, setup), setup.layout)


def loop_program(setup: Setup) -> Program:
    """Returns the program of many steps: the arguments of `resident_steps` -> StepCarry."""
    return _program(functools.partial(resident_steps, setup), setup.layout)


def batch_arguments(setup: Setup, batch: windows.Batch) -> tuple[StepCarry, windows.Batch]:
    """Returns shapes and shardings of the arguments of a step on a batch of these shapes."""
    split = devices.batch_sharding(setup.layout.mesh)
    return setup.layout.shapes(), jax.tree.map(lambda x: x.update(sharding=split), batch)


def loop_arguments(setup: Setup, dataset: windows.Dataset) -> tuple[Any, ...]:
    """Returns shapes and shardings of the arguments of steps on a dataset of these shapes."""
    whole, number = devices.replicated(setup.layout.mesh), jax.ShapeDtypeStruct((), jnp.int32)
    rows = jax.ShapeDtypeStruct(dataset.episode.shape, jnp.int32)
    data = jax.tree.map(lambda x: x.update(sharding=whole), (dataset, rows, number, number))
    return setup.layout.shapes(), *data


def prepare(step: Program, setup: Setup, data: tuple[Any, ...], loops: bool) -> None:
    """Compiles steps in the background until the first of them, unless they are prepared.

    Args:
      step: from `loop_program` if it `loops`, else from `batch_program`.
      setup: of the training.
      data: from `batches.on_devices`.
      loops: see `runs_in_a_loop`.
    """
    carry, mesh = setup.layout.shapes(), setup.layout.mesh
    if loops:
        arguments = carry, *data, devices.replicate(np.int32(1), mesh)
    else:
        draw, state = batches.drawing(setup), carry.state
        arguments = batch_arguments(setup, jax.eval_shape(draw, state.key, state.step, *data))
    if not step.is_prepared(*arguments):
        step.prepare(*arguments)


def _program(body: Callable[..., StepCarry], layout: StateLayout) -> Program:
    options = devices.compiler_options(layout.mesh)
    return Program(
        body, donate_argnums=0, out_shardings=layout.shardings(), compiler_options=options
    )
