"""Training from a dataset to a finished state: resume, log, checkpoint, stop."""

import pathlib
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax import config, errors, methods
from starjax.data import normalizer, windows
from starjax.policies import features
from starjax.policies import policy as policies
from starjax.runtime import background, processes, progress
from starjax.sim.tasks.base import Task
from starjax.training import checkpoint, devices, encoder, holdout
from starjax.training import log as metrics
from starjax.training import state as states
from starjax.training import stepper as advancing
from starjax.training.sharding import Carried

_CALL_SECONDS = 1.0  # aim of one compiled call: how long Ctrl-C waits, how often the bar moves


class Interrupted(KeyboardInterrupt):
    """Training was asked to stop; its checkpoint is written and the same command goes on."""


class Result(NamedTuple):
    """What training leaves.

    Attributes:
      state: after the last step.
      samples_per_second: of this process, compilation aside; 0 if there was nothing left to do.
      skipped: steps left out because their loss or gradient was not finite.
      holdout: last errors on demonstrations kept out; empty if none were.
    """

    state: states.TrainState
    samples_per_second: float
    skipped: int
    holdout: dict[str, float]


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
) -> Result:
    """Trains a method, going on from the newest sound checkpoint in the directory.

    Interrupted and resumed, or run through: the result is the same to the last bit.

    Args:
      method: row of Table II, whose own weights are trained.
      policy_config: networks and diffusion.
      train_config: optimisation.
      dataset: on the device (jax arrays) or on the host, see `windows.Dataset`; with features
        instead of images for a frozen vision encoder, whose parameters stay out of the state.
      task: that was demonstrated.
      directory: gets `checkpoints/` and, from the first process, `metrics.jsonl`.
      seed: of everything random.
      cameras: that the policy reads, in this order; empty: the task's first one.
      mesh_devices: all of jax's by default.
      should_stop: asked about once a second; True saves and raises Interrupted.
      description: name of the progress bar.

    Raises:
      Interrupted: after `should_stop`.
      StorageError: the disk is full.
      UsageError: the directory holds a training of another seed, of other demonstrations, or of
        more steps; or no loss of a whole stretch of the log was finite. That its method and
        settings are these is for the caller to see to, as `experiments.folders.claim` does.
    """
    directory = pathlib.Path(directory)
    log = directory / "metrics.jsonl"
    mesh = devices.make_mesh(train_config.batch_size, mesh_devices)
    dataset = _observed(dataset, policy_config, features.sensors(task, cameras))
    policy = policies.make(method, policy_config, task, train_config, cameras)
    optimizer = states.make_optimizer(train_config)
    train, held_out = windows.split_holdout(
        dataset.start, dataset.length, dataset.trocar, train_config.holdout_demos
    )
    row = policies.ablated(method, policy_config)
    stats = normalizer.fit(row, task, dataset, train)

    def around(params):
        return states.create(policy, optimizer, params, stats, seed)

    checkpoints = directory / "checkpoints"
    begun = states.init(policy, seed)
    new = not checkpoint.steps(checkpoints)  # a restored training may be finished
    drawn = background.run_in_background(begun.drawn) if new else begun.drawn
    like = _like(around, begun, mesh)
    it = advancing.Training(policy, optimizer, policy_config, train_config, mesh, dataset, train)
    advance = advancing.resident(it, like, ahead=new) if windows.on_device(dataset) else None
    state = _restored(checkpoints, like)
    if state is None:
        state = states.run_once(around, _begun(drawn(), policy_config))
        state = devices.replicate(state, mesh)
    else:
        _check_same(directory, state, states.keys(seed)[1], stats, train_config.steps)
    del drawn  # it holds what was drawn
    step = saved = int(state.step)
    judge = None
    if processes.is_first():
        metrics.resume(log, step)
        judge = holdout.make(policy, policy_config, dataset, held_out)
    if step == train_config.steps:
        errors = judge(processes.own(state)) if judge else {}
        return Result(state, 0.0, int(state.skipped), errors)
    if advance is None:
        advance = advancing.streamed(it, state)
    carried = advance.begin(state)
    del state  # on several devices, memory that the steps may need
    errors: dict[str, float] = {}
    rate = _Rate(train_config.batch_size)
    with progress.track(description, train_config.steps, unit="steps", done=step) as show:
        note, call = "", 1
        while step < train_config.steps:
            # Processes of one run stop together, and after the same steps.
            stop, calls = processes.gathered(should_stop(), call)
            call = calls[0]
            if any(stop):
                if step > saved:
                    _save(directory, advance.end(carried), train_config)
                raise Interrupted(
                    f"stopped after step {step} of {train_config.steps}; what is done is in "
                    f"{directory}, the same command goes on from there"
                )
            count = min(call, *(_until(step, n) for n in _stops(train_config)))
            count = min(count, train_config.steps - step)
            start = time.monotonic()
            carried = advance.several(carried, count)
            jax.block_until_ready(carried[0].step)
            call = rate.next_call(count, time.monotonic() - start, train_config.steps_per_call)
            step += count
            last = step == train_config.steps
            if step % train_config.log_every == 0 or last:
                carried, note = _log(log, step, carried, train_config)
            if step % train_config.checkpoint_every == 0 or last:
                state = advance.end(carried)  # by all processes together
                if judge:
                    errors = judge(processes.own(state))
                    metrics.append(log, step, "holdout", errors)
                _save(directory, state, train_config)
                saved = step
                del state
            show(count, note=note)
    state = advance.end(carried)
    return Result(state, rate.samples_per_second, int(state.skipped), errors)


def _observed(
    dataset: windows.Dataset, policy_config: config.PolicyConfig, seen: features.Sensors
) -> windows.Dataset:
    """The dataset without what the policy does not look at, so that nobody gathers it."""
    given = dataset.observation
    kept = "images" if policy_config.observation == "image" else "state"
    kept = "features" if policy_config.freeze_encoder else kept
    images = {name: (given.images or {}).get(name) for name in seen.cameras}
    unseen = {name: None for name in ("images", "state", "features") if name != kept}
    return dataset.replace(observation=given._replace(**{"images": images, **unseen}))


def _like(around, begun, mesh) -> states.TrainState:
    """Shapes and places of the state, without the state."""
    placed = devices.replicated(mesh)
    return jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=placed),
        jax.eval_shape(around, begun.traced.out_info),
    )


def _restored(checkpoints, like) -> states.TrainState | None:
    restored = checkpoint.restore(checkpoints, like) if checkpoint.steps(checkpoints) else None
    step = -1 if restored is None else restored[0]
    if processes.agree(step) != (step,):
        raise errors.UsageError(
            str(checkpoints.parent), "a folder that all processes share", "other checkpoints in it"
        )
    return None if restored is None else restored[1]


def _check_same(directory, state, key, stats, steps) -> None:
    """Raises UsageError for a state of another training."""
    if not np.array_equal(jax.random.key_data(state.key), jax.random.key_data(key)):
        raise errors.UsageError("seed", f"that of the training in {directory}", "another")
    if not all(map(_alike, jax.tree.leaves(state.normalizer), jax.tree.leaves(stats))):
        raise errors.UsageError(
            "the demonstrations", f"those of the training in {directory}", "others"
        )
    if int(state.step) > steps:
        done = f"{state.step} or more, which the training in {directory} has done"
        raise errors.UsageError("train.steps", done, steps)


def _alike(one, other) -> bool:
    """Whether two statistics are of the same data: another processor has other last bits."""
    return np.shape(one) == np.shape(other) and np.allclose(one, other, rtol=1e-5, atol=1e-6)


def _begun(drawn, policy_config) -> policies.Params:
    """Parameters of a new training, of drawn ones."""
    params = states.on_device(drawn)
    begins = policy_config.observation == "image" and not policy_config.freeze_encoder
    if begins and policy_config.encoder_weights:
        params = encoder.start(params, policy_config)
    return params


def _log(log, step, carried, train_config) -> tuple[Carried, str]:
    """Writes the means since the last line and starts the sums afresh."""
    state, narrow = carried
    sums = {name: float(value) for name, value in state.sums.items()}
    taken, skipped = int(sums.pop("taken")), int(sums.pop("skipped"))
    # A single step says nothing, as where the training's end cuts a stretch short.
    if taken == 0 and (skipped >= max(train_config.log_every, 2) or 1 < step == int(state.skipped)):
        raise errors.UsageError(
            "train.learning_rate",
            "one at which losses stay finite",
            f"{train_config.learning_rate:g}, none finite in {skipped} steps before step {step}",
            "lower it, or use policy.dtype float32",
        )
    values = {name: value / taken for name, value in sums.items()} if taken else {}
    last = step - 1 - int(state.skipped)  # as the optimiser counts, which sees no skipped step
    values["learning_rate"] = float(jnp.asarray(states.learning_rate(train_config)(last)))
    values["skipped"] = skipped
    if processes.is_first():
        metrics.append(log, step, "train", values)
    note = f"loss {values['loss']:.4f}" if taken else "no finite loss"
    note += f", {skipped} steps skipped" if skipped else ""
    # placed as they were: another placement would be another program
    fresh = jax.tree.map(lambda x: jax.device_put(jnp.zeros_like(x), x.sharding), state.sums)
    return (state.replace(sums=fresh), narrow), note


def _save(directory, state, train_config) -> None:
    checkpoint.save(
        directory / "checkpoints", int(state.step), state, keep=train_config.keep_checkpoints
    )


def _stops(train_config: config.TrainConfig) -> tuple[int, int]:
    return train_config.log_every, train_config.checkpoint_every


def _until(step: int, every: int) -> int:
    """Steps from `step` to the next multiple of `every`."""
    return every - step % every


class _Rate:
    """Throughput without the first call (which compiles), and how long the next call should be."""

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
