"""Inference times of policies: the rows of Table IV."""

import functools
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.core import config, methods
from starjax.core.types import Observation
from starjax.data import normalizer
from starjax.policies import features, generator
from starjax.policies import policy as policies
from starjax.policies.models import roll_net
from starjax.policies.sequences import Params
from starjax.runtime import precompile as precompile_lib
from starjax.sim import wrists
from starjax.sim.task import Field

_WARM_UP = 3  # calls before the clock starts


def policy_ms(
    policy: policies.Policy,
    policy_config: config.PolicyConfig,
    params: Params,
    stats: normalizer.Normalizer,
    sensors: features.Sensors,
    *,
    batch: int = 1,
    calls: int = 100,
    seconds: float = 10.0,
) -> dict[str, float]:
    """Measures one call of a policy, from an observation on the device to finished commands.

    Args:
      policy: to be timed.
      policy_config: shapes of its observations.
      params: of the policy.
      stats: its normaliser.
      sensors: the task and the cameras that it was made for.
      batch: robots that are served at once.
      calls: timed calls, fewer if they take longer than `seconds` altogether.
      seconds: see `calls`; at least five calls are made.

    Returns:
      {p50, p95, p99} in ms, and n, the number of calls.
    """

    def draw_inputs() -> Any:
        return _inputs(policy_config, sensors, batch)

    # In one program: called as they are, the maps would be a hundred.
    inputs = precompile_lib.Program(draw_inputs)()
    # Weights on the host would be copied again at each call.
    params, stats = jax.device_put((params, stats))
    call = _program(policy.sample, _slots(sensors)).select(params, stats, *inputs)
    return _percentiles(lambda: call(params, stats, *inputs), calls, seconds)


def precompile(
    policy: policies.Policy,
    policy_config: config.PolicyConfig,
    params: Params,
    stats: normalizer.Normalizer,
    sensors: features.Sensors,
) -> None:
    """Compiles, in the background, the program that `policy_ms` times at batch 1.

    The arguments are those of `policy_ms`; `params` and `stats` are arrays or their shapes.
    """
    inputs = jax.eval_shape(lambda: _inputs(policy_config, sensors, 1))
    _program(policy.sample, _slots(sensors)).prepare(params, stats, *inputs)


def table(
    method: methods.Method,
    policy_config: config.PolicyConfig,
    params: Params,
    stats: normalizer.Normalizer,
    sensors: features.Sensors,
    *,
    ddim_steps: Sequence[int],
    calls: int = 100,
    seconds: float = 10.0,
) -> Iterator[dict[str, float]]:
    """Yields rows {ddim_steps, p50, p95, p99, n} of one method at batch 1, times in ms.

    Its learner must have the option `ddim_steps`.
    """
    for steps in ddim_steps:
        changed = config.with_options(policy_config, ddim_steps=steps)
        policy = policies.make(method, changed, sensors.task, cameras=sensors.cameras)
        times = policy_ms(policy, changed, params, stats, sensors, calls=calls, seconds=seconds)
        yield {"ddim_steps": steps, **times}


def roll_ms(
    policy_config: config.PolicyConfig,
    sensors: features.Sensors,
    *,
    batch: int = 1,
    calls: int = 200,
    seconds: float = 5.0,
) -> dict[str, float]:
    """Measures the roll network alone, the hierarchy's overhead; weights do not matter."""
    batch *= sensors.task.arms
    net = roll_net.RollNet(
        width=policy_config.roll_width,
        blocks=policy_config.roll_blocks,
        dtype=jnp.dtype(policy_config.dtype),
    )
    inputs = [
        jnp.zeros((batch, policy_config.horizon, 3)),
        jnp.zeros((batch, features.TROCAR_FEATURES)),
        jnp.zeros((batch, policy_config.obs_horizon)),
    ]
    if policy_config.roll_observation:
        inputs.append(
            jnp.zeros((batch, generator.sizes(policy_config, sensors, action=4).observed))
        )
    params = net.init(jax.random.key(0), *inputs)
    apply = jax.jit(net.apply)
    return _percentiles(lambda: apply(params, *inputs), calls, seconds)


def example(
    policy_config: config.PolicyConfig, sensors: features.Sensors, batch: int
) -> tuple[Observation, rcm.Trocar]:
    """Returns a plausible observation `[batch, O, A]`, tools above ground; trocars `[batch, A]`."""
    trocar = rcm.sample_trocar(jax.random.key(1), (batch, sensors.task.arms))
    shape = (batch, policy_config.obs_horizon)
    action = jnp.broadcast_to(jnp.array([0.0, 0.0, 0.0, 0.02]), (*shape, sensors.task.arms, 4))
    frame = features.per_step(_frame(_slots(sensors), trocar))
    pose, _ = rcm.ACTION_SPACES["rcm4"].decode(action, frame)
    arms = (*shape, sensors.task.arms)
    bends = any(wrists.per_arm(sensors.task))
    observation = Observation(pose, jnp.ones(arms), wrist=jnp.zeros((*arms, 2)) if bends else None)
    if policy_config.observation == "state":
        state = jnp.concatenate([_plausible(field) for field in sensors.task.fields])
        return observation._replace(state=jnp.broadcast_to(state, (*shape, len(state)))), trocar
    size = (*shape, policy_config.image_size, policy_config.image_size, 3)
    keys = jax.random.split(jax.random.key(2), len(sensors.cameras))
    images = {
        name: jax.random.randint(key, size, 0, 256, jnp.uint8)
        for name, key in zip(sensors.cameras, keys, strict=True)
    }
    return observation._replace(images=images), trocar


Slots = tuple[tuple[tuple[float, ...], float], ...]  # p_world_ref and roll_zero of each arm


@functools.lru_cache(maxsize=4)
def _program(sample: Callable[..., Any], slots: Slots) -> precompile_lib.Program:
    def infer(params, stats, keys, observation, trocar):
        return sample(params, stats, keys, observation, _frame(slots, trocar))

    return precompile_lib.Program(infer)


def _slots(sensors: features.Sensors) -> Slots:
    return tuple((tuple(map(float, s.p_world_ref)), float(s.roll_zero)) for s in sensors.task.slots)


def _inputs(policy_config: config.PolicyConfig, sensors: features.Sensors, batch: int) -> Any:
    """Returns the inputs of one inference: keys, observation, trocars."""
    keys = jax.random.split(jax.random.key(0), batch)
    return keys, *example(policy_config, sensors, batch)


def _frame(slots: Slots, trocar: rcm.Trocar) -> rcm.TrocarFrame:
    """Returns the frames of trocars `[B, A]`, which are relative to the arms' nominal ones."""
    p_world_ref, roll_zero = zip(*slots, strict=True)
    return rcm.trocar_frame(trocar, np.array(p_world_ref, np.float32), np.array(roll_zero))


def _plausible(field: Field) -> jax.Array:
    """Returns plausible values of a state field: a point 1 cm above the origin, no rotation."""
    if field.kind == "point":
        return jnp.resize(jnp.array([0.0, 0.0, 0.01]), (field.size,))
    if field.kind == "rot6d":
        return jnp.array([1.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    return jnp.zeros(field.size)


def _percentiles(call: Callable[[], Any], calls: int, seconds: float) -> dict[str, float]:
    for _ in range(_WARM_UP):
        jax.block_until_ready(call())
    times = []
    deadline = time.perf_counter() + seconds
    while len(times) < calls and (len(times) < 5 or time.perf_counter() < deadline):
        start = time.perf_counter()
        jax.block_until_ready(call())
        times.append(1e3 * (time.perf_counter() - start))
    p50, p95, p99 = np.percentile(times, [50, 95, 99])
    return {"p50": float(p50), "p95": float(p95), "p99": float(p99), "n": len(times)}
