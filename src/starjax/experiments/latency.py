"""How long one decision takes (Table IV): observation in, commands out, one at a time."""

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from starjax import config as config_lib
from starjax import rcm
from starjax.experiments import methods
from starjax.models import roll_net
from starjax.policies import features
from starjax.policies import policy as policies
from starjax.sim.types import Observation
from starjax.training import export
from starjax.types import Pose

QUANTILES = {"p50": 0.5, "p95": 0.95, "p99": 0.99}


def decision(
    method: str,
    trained: export.Trained,
    p_world_ref: Any,
    repeats: int,
    ddim_steps: int | None = None,
) -> dict[str, float]:
    """Quantiles in ms of a method's whole decision at batch 1, without its compilation.

    Args:
      method: a row of Table II.
      trained: its weights.
      p_world_ref: `[3]` m, the nominal port.
      repeats: decisions timed.
      ddim_steps: in the place of the policy's own.

    Returns:
      {p50, p95, p99, repeats}.
    """
    steps = ddim_steps or trained.policy.ddim_steps
    settings = dataclasses.replace(trained.policy, ddim_steps=steps)
    policy = policies.make(methods.METHODS[method], settings, p_world_ref, trained.train)
    sample = jax.jit(policy.sample)
    seen, port = _observation(trained.policy, p_world_ref), _port()
    keys = jax.random.split(jax.random.key(0), repeats + 1)
    params, stats = jax.device_put((trained.params, trained.normalizer))
    return _quantiles(lambda i: sample(params, stats, keys[i : i + 1], seen, port), repeats)


def roll_network(
    trained: export.Trained, p_world_ref: Any, repeats: int
) -> dict[str, float] | None:
    """Quantiles in ms of the roll network alone, None where the policy has none."""
    if "roll" not in trained.params:
        return None
    settings = trained.policy
    network = roll_net.RollNet(
        width=settings.roll_width, blocks=settings.roll_blocks, dtype=jnp.dtype(settings.dtype)
    )
    apply = jax.jit(network.apply)
    p = jnp.zeros((1, settings.horizon, 3))
    trocar = features.trocar_features(_port(), jnp.asarray(p_world_ref))
    history = jnp.zeros((1, settings.obs_horizon))
    params = jax.device_put(trained.params["roll"])
    return _quantiles(lambda i: apply(params, p, trocar, history), repeats)


def _quantiles(call: Callable[[int], Any], repeats: int) -> dict[str, float]:
    jax.block_until_ready(call(repeats))  # compiles
    taken = []
    for i in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(call(i))
        taken.append(1e3 * (time.perf_counter() - start))
    values = np.quantile(taken, list(QUANTILES.values()))
    return {**dict(zip(QUANTILES, values.round(4).tolist())), "repeats": repeats}


def _observation(settings: config_lib.PolicyConfig, p_world_ref: Any) -> Observation:
    """Any observation `[1, O]`: its values do not change the time."""
    shape, size = (1, settings.obs_horizon), settings.image_size
    identity = jnp.broadcast_to(jnp.eye(3), (*shape, 3, 3))
    is_image = settings.observation == "image"
    return Observation(
        pose=Pose(identity, jnp.broadcast_to(jnp.asarray(p_world_ref, jnp.float32), (*shape, 3))),
        gripper=jnp.ones(shape),
        image=jnp.zeros((*shape, size, size, 3), jnp.uint8) if is_image else None,
        state=None if is_image else jnp.zeros((*shape, features.TASK_STATE)),
    )


def _port() -> rcm.Trocar:
    return rcm.Trocar(*(jnp.asarray(field[:1]) for field in rcm.TROCARS))
