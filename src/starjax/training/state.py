"""Everything that training carries from step to step, and so everything that a checkpoint holds."""

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import optax

from starjax import config
from starjax.data import normalizer
from starjax.policies.base import Params, Policy
from starjax.runtime import garbage


@flax.struct.dataclass
class TrainState:
    """A pure function of (settings, data, seed, step).

    Attributes:
      step: int32 `[]`, steps taken.
      params: of the policy.
      ema_params: their exponential moving average, what is evaluated.
      opt_state: of the optimiser.
      normalizer: fitted once; on resume it is what the checkpoint holds.
      key: typed key; step s uses `fold_in(key, s)` and nothing else.
      skipped: int32 `[]`, steps whose loss or gradient was not finite.
      sums: named float32 scalars, added up since the last line of the log.
    """

    step: Any
    params: Any
    ema_params: Any
    opt_state: Any
    normalizer: normalizer.Normalizer
    key: Any
    skipped: Any
    sums: dict[str, Any]


def learning_rate(train_config: config.TrainConfig) -> optax.Schedule:
    """Linear warm-up, then half a cosine down to zero."""
    warmup = min(train_config.warmup_steps, train_config.steps // 2)
    return optax.warmup_cosine_decay_schedule(
        init_value=0.0,
        peak_value=train_config.learning_rate,
        warmup_steps=warmup,
        decay_steps=max(train_config.steps, 1),
    )


def make_optimizer(train_config: config.TrainConfig) -> optax.GradientTransformation:
    """AdamW with Diffusion Policy's betas; kernels of the roll network may decay faster."""
    parts = [
        optax.scale_by_adam(b1=0.95, b2=0.999),
        optax.add_decayed_weights(train_config.weight_decay),
    ]
    if train_config.roll_weight_decay:
        parts.append(optax.add_decayed_weights(train_config.roll_weight_decay, _are_of_roll))
    return optax.chain(*parts, optax.scale_by_learning_rate(learning_rate(train_config)))


def _are_of_roll(params: Any) -> Any:
    """Which leaves are kernels of the roll network, packed or not."""

    def is_one(path: tuple[Any, ...], _: Any) -> bool:
        names = [getattr(entry, "key", None) for entry in path]
        return "roll" in names and names[-1] == "kernel"

    return jax.tree_util.tree_map_with_path(is_one, params)


class Init(NamedTuple):
    """A policy's parameters before the first step, traced but not yet drawn.

    Attributes:
      traced: the program, whose `out_info` are the shapes.
      key: what it is to be called with.
    """

    traced: jax.stages.Traced
    key: jax.Array

    def drawn(self) -> Params:
        """The parameters, where they were drawn."""
        return jax.block_until_ready(self.traced.lower().compile()(self.key))


def on_device(params: Params) -> Params:
    """`Init.drawn`, on jax's first device."""
    return jax.device_put(jax.device_get(params))


def init(policy: Policy, seed: int) -> Init:
    """Traces the policy's parameters, for the host if it can: a GPU's compiler takes 14 s for so
    many small draws."""
    try:
        place = jax.local_devices(backend="cpu")[0]
    except RuntimeError:  # JAX_PLATFORMS leaves it out
        place = jax.local_devices()[0]
    key = jax.device_put(keys(seed)[0], place)
    with garbage.gc_paused():
        return Init(_quick(policy.init).trace(key), key)


def run_once(fn: Callable[..., Any], *args: Any) -> Any:
    """`fn(*args)` as one program, not optimised: it takes less time than that would.

    Called as it is, `fn` would compile a program for each of its hundred small arrays.
    """
    return _quick(fn)(*args)


def _quick(fn: Callable[..., Any]) -> Any:
    return jax.jit(fn, compiler_options={"xla_backend_optimization_level": 0})


def create(
    policy: Policy,
    optimizer: optax.GradientTransformation,
    params: Params,
    stats: normalizer.Normalizer,
    seed: int,
) -> TrainState:
    """The state before the first step.

    Args:
      policy: to be trained.
      optimizer: from `make_optimizer`.
      params: from `Init.drawn`.
      stats: fitted to the training frames.
      seed: of everything random.
    """
    _, key = keys(seed)
    names = ["loss", "gradient_norm", "taken", "skipped", *policy.metrics]
    return TrainState(
        step=jnp.int32(0),
        params=params,
        ema_params=jax.tree.map(jnp.copy, params),
        opt_state=optimizer.init(params),
        normalizer=stats,
        key=key,
        skipped=jnp.int32(0),
        sums={name: jnp.float32(0.0) for name in names},
    )


def ema_decay(step: jax.Array, ema_max: float) -> jax.Array:
    """1 - (1 + s)^-0.75, at most `ema_max`: young averages forget fast."""
    return jnp.minimum(1.0 - (1.0 + step) ** -0.75, ema_max)


def keys(seed: int) -> jax.Array:
    """Keys of the parameters and of the steps."""
    return jax.random.split(jax.random.key(seed))
