"""Compiled training steps, on a dataset that is on the device or one of the host."""

import functools
import itertools
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax.core import errors
from starjax.data import windows
from starjax.runtime import processes
from starjax.runtime.precompile import Program
from starjax.training import devices, prefetch, randomise, redrawing
from starjax.training import step as steps
from starjax.training.sharding import StateLayout, StepCarry
from starjax.training.state import TrainState
from starjax.training.step import Setup


class Stepper(NamedTuple):
    """Compiled training steps.

    Attributes:
      begin: TrainState -> StepCarry; the steps may reuse the state's memory.
      run: (StepCarry, n) -> StepCarry after n steps, in the given one's memory.
      end: StepCarry -> TrainState; further steps may reuse the state's memory.
    """

    begin: Callable[[TrainState], StepCarry]
    run: Callable[[StepCarry, int], StepCarry]
    end: Callable[[StepCarry], TrainState]


def resident(
    setup: Setup,
    dataset: windows.Dataset,
    frames: np.ndarray,
    ahead: bool,
    program: Program | None = None,
    draw_images: redrawing.Draw | None = None,
) -> Stepper:
    """Makes steps on a dataset that is on the device; every device of the mesh gets a copy.

    Args:
      setup: of the training.
      dataset: leaves are jax arrays.
      frames: `[n]` frame numbers to draw from.
      ahead: trace the program now, and compile it in the background until the first step.
      program: from `batch_program` or `loop_program` of an equal setup, perhaps prepared.
      draw_images: draws those that training draws anew; None without any.
    """
    layout = setup.layout
    data = _on_devices(setup, dataset, frames)
    if steps.runs_in_a_loop(setup.policy_config):
        return _looped(setup, data, ahead, program or loop_program(setup))
    # A program of its own draws the batch: the large one is the same for any number of frames, and
    # can be compiled before these are known.
    split = devices.batch_sharding(layout.mesh)
    draw = jax.jit(functools.partial(steps.drawn_batch, setup), out_shardings=split)
    shapes = jax.eval_shape(draw, *_drawn_by(layout.shapes()), *data)
    arguments = abstract_arguments(setup, shapes)
    program = program or batch_program(setup)
    if ahead and not program.is_prepared(*arguments):
        program.prepare(*arguments)
    displaced = _displaced(setup, data, ahead, draw_images)

    def run(carry: StepCarry, count: int) -> StepCarry:
        take_step = program.select(*arguments)
        for images in displaced(carry, count):
            carry = take_step(carry, draw(*_drawn_by(carry), *data, images))
        return carry

    return _stepper(layout, run)


def streamed(
    setup: Setup,
    dataset: windows.Dataset,
    frames: np.ndarray,
    state: TrainState,
    draw_images: redrawing.Draw | None = None,
) -> Stepper:
    """Makes steps on a dataset of the host, whose batches follow those before `state`."""
    program = batch_program(setup)
    key = jnp.copy(processes.own(state.key))
    batches = prefetch.batches(setup, dataset, frames, key, int(state.step))
    if not setup.train_config.randomise:
        disturb, data, displaced = None, (), _displaced(setup, (), False, None)
    else:
        data = _on_devices(setup, windows.places(dataset), frames)
        disturb = jax.jit(functools.partial(_disturbed, setup))
        displaced = _displaced(setup, data, True, draw_images)

    def run(carry: StepCarry, count: int) -> StepCarry:
        for images in displaced(carry, count):
            batch = next(batches)
            if disturb:
                batch = disturb(*_drawn_by(carry), batch, images, *data)
            carry = program(carry, batch)
        return carry

    return _stepper(setup.layout, run)


def _looped(setup: Setup, data: tuple[Any, ...], ahead: bool, program: Program) -> Stepper:
    """Returns many steps in one program, of whose arguments the dataset is one."""
    layout = setup.layout

    def counted(count: int) -> jax.Array:
        return devices.replicate(np.int32(count), layout.mesh)

    arguments = layout.shapes(), *data, counted(1)
    if ahead and not program.is_prepared(*arguments):
        program.prepare(*arguments)
    return _stepper(layout, lambda carry, count: program(carry, *data, counted(count)))


def _on_devices(setup: Setup, dataset: windows.Dataset, frames: np.ndarray) -> tuple[Any, ...]:
    """Returns a dataset, frames to draw from and their number on every device."""
    rows = windows.padded_count(max(len(frames), len(dataset.episode)))
    available = np.pad(frames, (0, rows - len(frames))), np.int32(len(frames))
    return devices.replicate((dataset, *available), setup.layout.mesh, may_alias=None)


def _disturbed(
    setup: Setup, key: Any, step: Any, batch: windows.Batch, displaced: Any, *data: Any
) -> windows.Batch:
    return steps.disturbed(setup, steps.choose(setup, key, step, *data), batch, displaced)


def _displaced(
    setup: Setup, data: tuple[Any, ...], ahead: bool, draw: redrawing.Draw | None
) -> Callable[[StepCarry, int], Iterator[redrawing.Displaced | None]]:
    """Returns the function from a carry and a number of steps to the steps' displaced images."""
    if not randomise.redraws(setup.train_config):
        return lambda carry, count: itertools.repeat(None, count)
    if draw is None or data[0].sources is None:
        expected = (
            "neither camera nor look without sources of images and a function that draws them"
        )
        raise errors.UsageError(randomise.ARGUMENT, expected, "one of them")
    of = redrawing.make(setup, draw, data, ahead)

    def each(carry: StepCarry, count: int) -> Iterator[redrawing.Displaced]:
        key, first = jnp.copy(carry.state.key), int(carry.state.step)  # a step takes its memory
        return (of(key, step) for step in range(first, first + count))

    return each


def _drawn_by(carry: StepCarry) -> tuple[Any, Any]:
    """Returns the key and the number of the step, which decide its batch."""
    return carry.state.key, carry.state.step


def batch_program(setup: Setup) -> Program:
    """Returns the program of one step on a batch: (StepCarry, Batch) -> StepCarry."""
    return _program(functools.partial(steps.train_step, setup), setup.layout)


def loop_program(setup: Setup) -> Program:
    """Returns the program of many steps: the arguments of `step.resident_steps` -> StepCarry."""
    return _program(functools.partial(steps.resident_steps, setup), setup.layout)


def loop_arguments(setup: Setup, dataset: windows.Dataset) -> tuple[Any, ...]:
    """Returns shapes and shardings of the arguments of steps on a dataset of these shapes."""
    whole, number = devices.replicated(setup.layout.mesh), jax.ShapeDtypeStruct((), jnp.int32)
    rows = jax.ShapeDtypeStruct(dataset.episode.shape, jnp.int32)
    data = jax.tree.map(lambda x: x.update(sharding=whole), (dataset, rows, number, number))
    return setup.layout.shapes(), *data


def abstract_arguments(setup: Setup, batch: windows.Batch) -> tuple[StepCarry, windows.Batch]:
    """Returns shapes and shardings of the arguments of a step on a batch of these shapes."""
    split = devices.batch_sharding(setup.layout.mesh)
    return setup.layout.shapes(), jax.tree.map(lambda x: x.update(sharding=split), batch)


def _stepper(layout: StateLayout, run: Callable[[StepCarry, int], StepCarry]) -> Stepper:
    if layout.mesh.size == 1:  # no matrix moves between devices
        return Stepper(layout.to_carry, run, layout.to_state)
    begin = jax.jit(layout.to_carry, out_shardings=layout.shardings())
    end = jax.jit(layout.to_state, out_shardings=devices.replicated(layout.mesh))
    return Stepper(begin, run, end)


def _program(body: Callable[..., StepCarry], layout: StateLayout) -> Program:
    options = devices.compiler_options(layout.mesh)
    return Program(
        body, donate_argnums=0, out_shardings=layout.shardings(), compiler_options=options
    )
