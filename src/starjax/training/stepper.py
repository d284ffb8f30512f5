"""Compiled training steps, on a dataset that is on the device or one of the host."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax.data import windows
from starjax.runtime import background, garbage, processes
from starjax.training import devices, prefetch
from starjax.training import step as steps
from starjax.training.sharding import Carry, Layout
from starjax.training.state import TrainState
from starjax.training.step import Setup


class Stepper(NamedTuple):
    """Compiled training steps.

    Attributes:
      begin: TrainState -> Carry; the steps may reuse the state's memory.
      run: (Carry, n) -> Carry after n steps, in the given one's memory.
      end: Carry -> TrainState; further steps may reuse the state's memory.
    """

    begin: Callable[[TrainState], Carry]
    run: Callable[[Carry, int], Carry]
    end: Callable[[Carry], TrainState]


def resident(setup: Setup, dataset: windows.Dataset, frames: np.ndarray, ahead: bool) -> Stepper:
    """Makes steps on a dataset that is on the device; every device of the mesh gets a copy.

    Args:
      setup: of the training.
      dataset: leaves are jax arrays.
      frames: `[n]` frame numbers to draw from.
      ahead: the program is traced now, and compiled while the caller goes on until the first step.
    """
    layout = setup.layout
    data = devices.replicate((dataset, jnp.asarray(frames)), layout.mesh, may_alias=None)
    looped = steps.runs_in_a_loop(setup.policy_config)
    body = steps.resident_steps if looped else steps.resident_step
    program = _program(functools.partial(body, setup), layout)

    def counted(count: int) -> tuple[jax.Array, ...]:
        return (devices.replicate(np.int32(count), layout.mesh),) if looped else ()

    if ahead:
        program = _compiled_in_background(program, layout.shapes(), *data, *counted(1))

    def run(carry: Carry, count: int) -> Carry:
        for _ in range(1 if looped else count):
            carry = program(carry, *data, *counted(count))
        return carry

    return _stepper(layout, run)


def streamed(
    setup: Setup, dataset: windows.Dataset, frames: np.ndarray, state: TrainState
) -> Stepper:
    """Makes steps on a dataset of the host, whose batches follow those before `state`."""
    program = _program(functools.partial(steps.train_step, setup), setup.layout)
    key = jnp.copy(processes.own(state.key))
    batches = prefetch.batches(setup, dataset, frames, key, int(state.step))

    def run(carry: Carry, count: int) -> Carry:
        for _ in range(count):
            carry = program(carry, next(batches))
        return carry

    return _stepper(setup.layout, run)


def _stepper(layout: Layout, run: Callable[[Carry, int], Carry]) -> Stepper:
    if layout.mesh.size == 1:  # matrices stay where they are
        return Stepper(layout.to_carry, run, layout.to_state)
    begin = jax.jit(layout.to_carry, out_shardings=layout.shardings())
    end = jax.jit(layout.to_state, out_shardings=devices.replicated(layout.mesh))
    return Stepper(begin, run, end)


def _program(body: Callable[..., Carry], layout: Layout) -> Any:
    options = devices.compiler_options(layout.mesh)
    return jax.jit(
        body, donate_argnums=0, out_shardings=layout.shardings(), compiler_options=options
    )


def _compiled_in_background(program: Any, *shapes: Any) -> Callable[..., Carry]:
    """Compiles the program in a thread for arguments of these shapes; its first call waits."""
    # Traced here: in a thread it would take turns with what the caller does, both in Python.
    with garbage.gc_paused():
        lowered = program.lower(*shapes)
    compiled = background.run_in_background(lowered.compile)
    return lambda *args: compiled()(*args)
