"""Training from a dataset to a finished state: resume, log, checkpoint, stop."""

import functools
import itertools
import pathlib
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax.core import config, methods
from starjax.data import normalizer, windows
from starjax.policies import features
from starjax.policies import policy as policies
from starjax.rcm import arrays
from starjax.runtime import background, precompile, processes, progress
from starjax.sim.task import Task
from starjax.training import batches, checkpoint, devices, holdout, log, redrawing
from starjax.training import state as states
from starjax.training import step as steps
from starjax.training.sharding import Setup, StateLayout, StepCarry
from starjax.training.start import (
    Start,
    check_same,
    first_params,
    fitted,
    observed,
    restored,
)

_CALL_SECONDS = 1.0  # target duration of a compiled call, which delays Ctrl-C and the bar

HoldoutError = Callable[[states.TrainState], dict[str, float]]


class TrainingResult(NamedTuple):
    """A finished training.

    Attributes:
      state: after the last step.
      samples_per_second: of this process, compilation aside; 0 if training was complete.
      skipped: steps without an update, because their loss or gradient was not finite.
      holdout: last errors on demonstrations kept out; empty if none were.
    """

    state: states.TrainState
    samples_per_second: float
    skipped: int
    holdout: dict[str, float]


@arrays.broadcasting
def run(
    method: methods.Method,
    policy_config: config.PolicyConfig,
    train_config: config.TrainConfig,
    dataset: windows.Dataset,
    task: Task,
    directory: pathlib.Path | str,
    seed: int,
    *,
    cameras: Sequence[str] = (),
    mesh_devices: Sequence[jax.Device] | None = None,
    should_stop: Callable[[], bool] = lambda: False,
    description: str = "train",
    step_program: precompile.Program | None = None,
    draw_images: redrawing.Draw | None = None,
    start: Start | None = None,
) -> TrainingResult:
    """Trains a method, resuming from the newest sound checkpoint in the directory.

    Interrupted and resumed, or run through: the result is the same to the last bit.

    Args:
      method: row of `methods.METHODS`, whose own weights are trained.
      policy_config: networks and diffusion.
      train_config: optimisation.
      dataset: on the device (jax arrays) or on the host, see `windows.Dataset`; with features
        instead of images for a frozen vision encoder, whose parameters stay out of the state.
      task: that was demonstrated.
      directory: gets `checkpoints/` and, from the first process, `metrics.jsonl`.
      seed: of everything random.
      cameras: that the policy reads, in this order; empty: the task's first one.
      mesh_devices: all of jax's by default.
      should_stop: polled about once a second; True saves and raises KeyboardInterrupt.
      description: name of the progress bar.
      step_program: from `training.precompile` with these arguments.
      draw_images: draws those that training draws anew, from the dataset's sources; needed if
        `train_config.randomise` has such a disturbance.
      start: of a training that continues another; by default that of a new policy.

    Raises:
      KeyboardInterrupt: after `should_stop`.
      StorageError: the disk is full.
      UsageError: the directory holds a training of another seed, of other demonstrations, or of
        more steps; or no loss of a whole stretch of the log was finite. That its method and
        settings are these is for the caller to see to, as `cli.folders.claim` does.
    """
    directory = pathlib.Path(directory)
    mesh = devices.make_mesh(train_config.batch_size, mesh_devices)
    dataset = observed(dataset, policy_config, features.select_sensors(task, cameras))
    start = start or fitted(method, policy_config, train_config, dataset, task)
    stats, frames, held_out, given = start
    policy = policies.make(method, policy_config, task, train_config, cameras)
    optimizer = states.make_optimizer(train_config)
    streams = states.streams(seed)

    # A new training's parameters are drawn, and its steps compiled, while the rest is done here; a
    # restored one may be finished, and then needs neither.
    is_new = not checkpoint.steps(directory / "checkpoints")
    init = states.init(policy, streams.params)
    draws = is_new and given is None
    drawn = background.run_in_background(init.drawn) if draws else init.drawn
    shapes = states.shapes(
        policy, optimizer, init.shapes, stats, streams.steps, devices.replicated(mesh)
    )
    layout = StateLayout(mesh, policy.cast_params, shapes)
    setup = Setup(policy, optimizer, policy_config, train_config, layout)
    resident = windows.on_device(dataset)
    data: tuple[Any, ...] = ()
    if resident or train_config.randomise:
        placed = dataset if resident else windows.places(dataset)
        data = batches.on_devices(setup, placed, frames)
    loops = resident and steps.runs_in_a_loop(policy_config)
    step = step_program if resident else None
    step = step or (steps.loop_program if loops else steps.batch_program)(setup)
    if resident and is_new:
        steps.prepare(step, setup, data, loops)
    displace = redrawing.make(setup, draw_images, data, ahead=is_new)

    state = restored(directory / "checkpoints", shapes)
    if state is None:
        # Arguments, not constants: the program is the same for every seed.
        make = functools.partial(states.create, policy, optimizer)
        params = first_params(drawn(), policy_config) if given is None else given
        state = states.run_once(make, params, stats, streams.steps)
        del params
        state = devices.replicate(state, mesh)
    else:
        check_same(directory, state, streams.steps, stats, train_config.steps)
    del drawn, start, given  # frees the initial parameters

    holdout_error = None
    if processes.is_first():
        log.resume(directory / "metrics.jsonl", int(state.step))
        alone = shapes if mesh.size == 1 else None
        wrist = normalizer.wrist_of(method, task)
        holdout_error = holdout.make(policy, policy_config, dataset, held_out, alone, wrist)
    if int(state.step) == train_config.steps:
        held_out_errors = holdout_error(processes.own(state)) if holdout_error else {}
        return TrainingResult(state, 0.0, int(state.skipped), held_out_errors)
    number, key = int(state.step), jnp.copy(state.key)  # the steps take the state's memory
    if loops:
        stream = itertools.repeat(data)
    elif resident:
        stream = batches.resident(setup, data, key, number, displace)
    else:
        stream = batches.streamed(setup, dataset, frames, key, number, data, displace)
    to_carry, to_state = layout.transfers()
    carry = to_carry(state)
    del state  # on several devices, memory that the steps may need
    return _train(
        *(setup, step, stream, loops, carry, to_state, number),
        *(directory, holdout_error, should_stop, description),
    )


def _train(
    setup: Setup,
    step: precompile.Program,
    batches: Iterator[Any],
    loops: bool,
    state: StepCarry,
    to_state: Callable[[StepCarry], states.TrainState],
    number: int,
    directory: pathlib.Path,
    holdout_error: HoldoutError | None,
    should_stop: Callable[[], bool],
    description: str,
) -> TrainingResult:
    """Takes the steps after `number`, with regular lines of the log and checkpoints."""
    train_config, mesh = setup.train_config, setup.layout.mesh
    last, saved, held_out_errors = train_config.steps, number, {}
    pace = _Pace(train_config.batch_size)
    with progress.track(description, last, unit="steps", done=number) as show:
        note, call = "", 1
        while number < last:
            # Processes of one run stop together, and after the same steps.
            stop, calls = processes.gathered(should_stop(), call)
            if any(stop):
                if number > saved:
                    _save(directory, to_state(state), train_config)
                raise KeyboardInterrupt(
                    f"stopped after step {number} of {last}; its checkpoint is in {directory}, the "
                    "same command resumes from it"
                )
            log_at = _next(number, train_config.log_every)
            save_at = _next(number, train_config.checkpoint_every)
            count = min(number + calls[0], log_at, save_at, last) - number

            began = time.monotonic()
            if loops:  # the program draws the batches of all these steps itself
                dataset = next(batches)
                state = step(state, *dataset, devices.replicate(np.int32(count), mesh))
            else:
                compiled = None
                for _ in range(count):
                    batch = next(batches)
                    # Once a call: the look-up reads the shapes of every leaf.
                    compiled = compiled or step.select(state, batch)
                    state = compiled(state, batch)
            jax.block_until_ready(state.state.step)
            call = pace.next_call(count, time.monotonic() - began, train_config.steps_per_call)
            number += count

            if number in (log_at, last):
                state, note = _log(directory / "metrics.jsonl", number, state, train_config)
            if number in (save_at, last):
                whole = to_state(state)  # by all processes together
                if holdout_error:
                    held_out_errors = holdout_error(processes.own(whole))
                    log.append(directory / "metrics.jsonl", number, "holdout", held_out_errors)
                _save(directory, whole, train_config)
                saved = number
                del whole
            show(count, note=note)
    whole = to_state(state)
    return TrainingResult(whole, pace.samples_per_second, int(whole.skipped), held_out_errors)


@functools.cache
def _learning_rate(train_config: config.TrainConfig) -> precompile.Program:
    return precompile.Program(states.learning_rate(train_config))


def _log(
    path: pathlib.Path, step: int, carry: StepCarry, train_config: config.TrainConfig
) -> tuple[StepCarry, str]:
    """Writes the means since the last line and restarts the sums; returns a note for the bar."""
    state, skipped = carry.state, int(carry.state.skipped)
    values = states.mean_metrics(state.sums, step, skipped, train_config)
    here = values.pop("skipped")
    # The optimiser counts from 0 and sees no skipped step.
    rate = _learning_rate(train_config)(np.int32(step - 1 - skipped))
    values |= {"learning_rate": float(rate), "skipped": here}
    if processes.is_first():
        log.append(path, step, "train", values)
    note = f"loss {values['loss']:.4f}" if "loss" in values else "no finite loss"
    note += f", {here} steps skipped" if here else ""
    return carry._replace(state=state.replace(sums=states.restarted(state.sums))), note


def _save(
    directory: pathlib.Path, state: states.TrainState, train_config: config.TrainConfig
) -> None:
    checkpoint.save(
        directory / "checkpoints", int(state.step), state, keep=train_config.keep_checkpoints
    )


def _next(step: int, every: int) -> int:
    """Returns the next multiple of `every` after a step."""
    return step + every - step % every


class _Pace:
    """Throughput without the first call, which compiles, and the steps of the next call."""

    def __init__(self, batch_size: int):
        self._batch_size, self._steps, self._seconds, self._calls = batch_size, 0, 0.0, 0

    def next_call(self, count: int, seconds: float, most: int) -> int:
        self._calls += 1
        if self._calls == 1:
            return 1
        self._steps += count
        self._seconds += seconds
        return int(np.clip(_CALL_SECONDS / max(seconds / count, 1e-6), 1, most))

    @property
    def samples_per_second(self) -> float:
        return self._batch_size * self._steps / self._seconds if self._seconds else 0.0
