"""The state of a training run: the carry of its steps and the content of its checkpoints."""

import functools
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import optax

from starjax.core import config, errors
from starjax.core.types import ArrayTree
from starjax.data import normalizer
from starjax.policies.base import Params, Policy
from starjax.runtime.precompile import Program

Sums = dict[str, jax.Array]

_QUICK = {"xla_backend_optimization_level": 0}


class Streams(NamedTuple):
    """Typed keys of a training, all from its seed.

    Attributes:
      params: of the first parameters.
      steps: of the steps; see `step_keys`.
    """

    params: jax.Array
    steps: jax.Array


class StepKeys(NamedTuple):
    """Typed keys of one step.

    Attributes:
      batch: draws its frames.
      loss: augmentation, noise and diffusion steps.
    """

    batch: jax.Array
    loss: jax.Array


def streams(seed: int) -> Streams:
    """Splits a seed into the streams of a training."""
    return Streams(*jax.random.split(jax.random.key(seed)))


def step_keys(key: jax.Array, step: jax.Array) -> StepKeys:
    """Derives the keys of a step from those of all steps."""
    # A function of the step's number: a resumed training draws on as if it had not stopped.
    return StepKeys(*jax.random.split(jax.random.fold_in(key, step)))


@flax.struct.dataclass
class TrainState:
    """A pure function of (settings, data, seed, step).

    Attributes:
      step: int32 `[]`, steps taken.
      params: of the policy.
      ema_params: their exponential moving average, which is evaluated.
      opt_state: of the optimiser.
      normalizer: fitted once; on resume it is the checkpoint's.
      key: `Streams.steps`.
      skipped: int32 `[]`, steps whose loss or gradient was not finite.
      sums: of the metrics since the last line of the log, on the device.
    """

    step: Any
    params: Any
    ema_params: Any
    opt_state: Any
    normalizer: normalizer.Normalizer
    key: Any
    skipped: Any
    sums: Sums


def learning_rate(train_config: config.TrainConfig) -> optax.Schedule:
    """Returns linear warm-up, then half a cosine down to zero."""
    warmup = min(train_config.warmup_steps, train_config.steps // 2)  # short trainings warm up, too
    return optax.warmup_cosine_decay_schedule(
        init_value=0.0,
        peak_value=train_config.learning_rate,
        warmup_steps=warmup,
        decay_steps=max(train_config.steps, 1),
    )


def make_optimizer(train_config: config.TrainConfig) -> optax.GradientTransformation:
    """Returns AdamW with Diffusion Policy's betas; the roll network's kernels may decay faster."""
    parts = [
        optax.scale_by_adam(b1=0.95, b2=0.999),  # as Diffusion Policy
        # Decoupled: after the moments (AdamW)
        optax.add_decayed_weights(train_config.weight_decay),
    ]
    if train_config.roll_weight_decay:
        parts.append(optax.add_decayed_weights(train_config.roll_weight_decay, _are_of_roll))
    return optax.chain(*parts, optax.scale_by_learning_rate(learning_rate(train_config)))


def _are_of_roll(params: ArrayTree) -> Any:
    """Tells which leaves are kernels of the roll network, packed or not."""

    def is_one(path: tuple[Any, ...], _: Any) -> bool:
        names = [getattr(entry, "key", None) for entry in path]
        return "roll" in names and names[-1] == "kernel"

    return jax.tree_util.tree_map_with_path(is_one, params)


class Init(NamedTuple):
    """A policy's first parameters, traced but not yet drawn.

    Attributes:
      program: from a key to the parameters.
      key: its argument.
      shapes: of the parameters.
    """

    program: Program
    key: jax.Array
    shapes: Params

    def drawn(self) -> Params:
        """Draws the parameters; they stay on the device of the key."""
        return jax.block_until_ready(self.program(self.key))


def on_device(params: Params) -> Params:
    """Copies drawn parameters to jax's first device."""
    return jax.device_put(jax.device_get(params))


def init(policy: Policy, key: jax.Array) -> Init:
    """Traces a policy's first parameters, drawn with `Streams.params`.

    For the host where jax has one: a GPU's compiler takes 14 s for so many small draws.
    """
    try:
        place = jax.local_devices(backend="cpu")[0]
    except RuntimeError:  # JAX_PLATFORMS leaves it out
        place = jax.local_devices()[0]
    key = jax.device_put(key, place)
    program = Program(policy.init, compiler_options=_QUICK)
    return Init(program, key, program.shapes(key))


def run_once(fn: Callable[..., Any], *args: Any) -> Any:
    """Calls `fn(*args)` as one program that is not optimised, which would take longer.

    Called as it is, `fn` would compile a hundred programs, one per small array.
    """
    return Program(fn, compiler_options=_QUICK)(*args)


def create(
    policy: Policy,
    optimizer: optax.GradientTransformation,
    params: Params,
    stats: normalizer.Normalizer,
    key: jax.Array,
) -> TrainState:
    """Makes the state before the first step.

    Args:
      policy: to be trained.
      optimizer: from `make_optimizer`.
      params: from `Init.drawn`.
      stats: fitted to the training frames.
      key: `Streams.steps`.
    """
    return TrainState(
        step=jnp.int32(0),
        params=params,
        ema_params=jax.tree.map(jnp.copy, params),  # own memory: steps donate both
        opt_state=optimizer.init(params),
        normalizer=stats,
        key=key,
        skipped=jnp.int32(0),
        sums=zero_sums(policy.metrics),
    )


def shapes(
    policy: Policy,
    optimizer: optax.GradientTransformation,
    params: Params,
    stats: normalizer.Normalizer,
    key: jax.Array,
    sharding: jax.sharding.Sharding,
) -> TrainState:
    """Returns shapes and sharding of the state that `create` makes of these or of their shapes."""
    state = jax.eval_shape(functools.partial(create, policy, optimizer), params, stats, key)
    return jax.tree.map(lambda x: x.update(sharding=sharding), state)


def ema_decay(step: jax.Array, ema_max: float) -> jax.Array:
    """Returns 1 - (1 + s)^-0.75, at most `ema_max`: young averages forget fast."""
    return jnp.minimum(1.0 - (1.0 + step) ** -0.75, ema_max)


def zero_sums(names: Iterable[str]) -> Sums:
    """Returns the sums of no steps; `names` are the policy's own metrics."""
    own = ("loss", "gradient_norm", "taken", "skipped")
    return {name: jnp.float32(0.0) for name in (*own, *names)}


def add_metrics(sums: Sums, values: dict[str, jax.Array], finite: jax.Array) -> Sums:
    """Adds the metrics of one step, which was taken if they are finite."""
    after = {name: sums[name] + jnp.where(finite, values[name], 0.0) for name in values}
    after["taken"] = sums["taken"] + jnp.where(finite, 1.0, 0.0)
    after["skipped"] = sums["skipped"] + jnp.where(finite, 0.0, 1.0)
    return after


def restarted(sums: Sums) -> Sums:
    """Returns zeros, placed as the sums are: another placement would be another program."""
    return jax.tree.map(lambda x: jax.device_put(jnp.zeros_like(x), x.sharding), sums)


def mean_metrics(
    sums: Sums, step: int, skipped: int, train_config: config.TrainConfig
) -> dict[str, float]:
    """Returns the means over the steps that were taken, and how many were skipped.

    Args:
      sums: since the last line of the log.
      step: steps so far.
      skipped: of all of them.
      train_config: has the number of steps between two lines.

    Raises:
      errors.UsageError: nothing was finite in a whole stretch. A single step says nothing, as where
        the training's end cuts a stretch short.
    """
    values = {name: float(value) for name, value in sums.items()}
    taken, here = int(values.pop("taken")), int(values.pop("skipped"))
    if taken == 0 and (here >= max(train_config.log_every, 2) or 1 < step == skipped):
        raise errors.UsageError(
            "train.learning_rate",
            "one at which losses stay finite",
            f"{train_config.learning_rate:g}, none finite in {here} steps before step {step}",
            "lower it, or use policy.dtype float32",
        )
    values = {name: value / taken for name, value in values.items()} if taken else {}
    return {**values, "skipped": here}
