"""How long a policy takes to answer: the rows of Table IV."""

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from starjax import config, methods, rcm
from starjax.models import roll_net
from starjax.policies import diffuser, features
from starjax.policies import policy as policies
from starjax.sim.types import Observation

_WARM_UP = 3  # calls before the clock starts


def policy_ms(
    policy: policies.Policy,
    policy_config: config.PolicyConfig,
    params: Any,
    stats: Any,
    p_world_ref: Any,
    *,
    batch: int = 1,
    calls: int = 100,
    seconds: float = 10.0,
) -> dict[str, float]:
    """Time of one call of a policy, from an observation on the device to finished commands.

    Args:
      policy: to be timed.
      policy_config: shapes of its observations.
      params: of the policy.
      stats: its normaliser.
      p_world_ref: `[3]` m, the nominal port.
      batch: robots that are served at once.
      calls: timed calls, fewer if they take longer than `seconds` altogether.
      seconds: see `calls`; at least five calls are made.

    Returns:
      {p50, p95, p99} in ms, and n, the number of calls.
    """
    observation, trocar = example(policy_config, p_world_ref, batch)
    sample = jax.jit(policy.sample)
    keys = jax.random.split(jax.random.key(0), batch)
    # Weights on the host would be copied again at each call.
    params, stats = jax.device_put((params, stats))
    return _percentiles(lambda: sample(params, stats, keys, observation, trocar), calls, seconds)


def table(
    method: methods.Method,
    policy_config: config.PolicyConfig,
    train_config: config.TrainConfig,
    params: Any,
    stats: Any,
    p_world_ref: Any,
    *,
    ddim_steps: Sequence[int],
    calls: int = 100,
    seconds: float = 10.0,
) -> Iterator[dict[str, float]]:
    """Rows {ddim_steps, p50, p95, p99, n} of one method at batch 1, times in ms, as they come."""
    for steps in ddim_steps:
        changed = dataclasses.replace(policy_config, ddim_steps=steps)
        policy = policies.make(method, changed, p_world_ref, train_config)
        given = (policy, changed, params, stats, p_world_ref)
        yield {"ddim_steps": steps, **policy_ms(*given, calls=calls, seconds=seconds)}


def roll_ms(
    policy_config: config.PolicyConfig, *, batch: int = 1, calls: int = 200, seconds: float = 5.0
) -> dict[str, float]:
    """Time of the roll network alone, the hierarchy's overhead; its weights do not matter."""
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
        inputs.append(jnp.zeros((batch, diffuser.observed_dim(policy_config))))
    params = net.init(jax.random.key(0), *inputs)
    apply = jax.jit(net.apply)
    return _percentiles(lambda: apply(params, *inputs), calls, seconds)


def example(
    policy_config: config.PolicyConfig, p_world_ref: Any, batch: int
) -> tuple[Observation, rcm.Trocar]:
    """A plausible observation `[batch, O]` and the trocars `[batch]`: a tool above the board."""
    trocar = rcm.sample_trocar(jax.random.key(1), (batch,))
    shape = (batch, policy_config.obs_horizon)
    per_frame = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf[:, None], shape), trocar)
    action = jnp.broadcast_to(jnp.array([0.0, 0.0, 0.0, 0.02]), (*shape, 4))
    pose, _ = rcm.ACTION_SPACES["rcm4"].decode(action, per_frame, p_world_ref)
    image = state = None
    if policy_config.observation == "image":
        size = (*shape, policy_config.image_size, policy_config.image_size, 3)
        image = jax.random.randint(jax.random.key(2), size, 0, 256, jnp.uint8)
    else:
        state = jnp.broadcast_to(
            jnp.array([0.02, 0.0, 0.01, 1.0, 0, 0, 0, 1.0, 0, -0.02, 0.0, 0.01]),
            (*shape, features.TASK_STATE),
        )
    return Observation(pose, jnp.ones(shape), image, state), trocar


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
