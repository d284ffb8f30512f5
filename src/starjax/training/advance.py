"""Training steps as calls `(state, count) -> state` that reuse the given state's memory."""

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh

from starjax import config
from starjax.data import windows
from starjax.policies.policy import Policy
from starjax.training import devices, feed, processes
from starjax.training import step as steps
from starjax.training.state import TrainState

Advance = Callable[[TrainState, int], TrainState]


class Training(NamedTuple):
    """What steps are made of.

    Attributes:
      policy: to be trained.
      optimizer: from `state.make_optimizer`.
      policy_config: networks and horizons.
      train_config: optimisation.
      mesh: the batch is split over it.
      dataset: on the device or on the host.
      frames: `[n]` frame numbers to draw from.
    """

    policy: Policy
    optimizer: optax.GradientTransformation
    policy_config: config.PolicyConfig
    train_config: config.TrainConfig
    mesh: Mesh
    dataset: windows.Dataset
    frames: np.ndarray


def resident(it: Training, like: TrainState | None = None) -> Advance:
    """Steps on a dataset that is on the device, and is copied to every device of the mesh.

    With `like`, shapes and places of the state, the program is compiled from now on, beside what
    the caller does until the first step.
    """
    data = devices.replicate((it.dataset, jnp.asarray(it.frames)), it.mesh, may_alias=None)
    if steps.runs_in_a_loop(it.policy_config):
        return _looped(it, like, data)
    program = _program(functools.partial(steps.carried_step, *it[:5]), it.mesh)
    rounded = jax.jit(
        functools.partial(steps.rounded, dtype=it.policy_config.dtype),
        out_shardings=devices.replicated(it.mesh),
    )
    if like is not None:
        narrow = jax.eval_shape(rounded, like.params)
        placed = jax.tree.map(lambda x: x.update(sharding=like.step.sharding), narrow)
        program = _compiled_beside(program, (like, placed), *data)

    def advance(state: TrainState, count: int) -> TrainState:
        carried: Any = (state, rounded(state.params))
        for _ in range(count):
            carried = program(carried, *data)
        return carried[0]

    return advance


def _looped(it: Training, like: TrainState | None, data: Any) -> Advance:
    program = _program(functools.partial(steps.resident_steps, *it[:5]), it.mesh)

    def counted(count: int) -> jax.Array:
        return devices.replicate(np.int32(count), it.mesh)

    if like is not None:
        program = _compiled_beside(program, like, *data, counted(1))
    return lambda state, count: program(state, *data, counted(count))


def streamed(it: Training, state: TrainState) -> Advance:
    """Steps on a dataset of the host, whose batches follow this state's."""
    body = functools.partial(steps.train_step, it.policy, it.optimizer, it.train_config)
    program = _program(body, it.mesh)
    key = jnp.copy(processes.own(state.key))
    stream = feed.batches(
        it.dataset, it.frames, it.policy_config, it.train_config, it.mesh, key, int(state.step)
    )

    def advance(state: TrainState, count: int) -> TrainState:
        for _ in range(count):
            state = program(state, next(stream))
        return state

    return advance


def _program(body: Callable[..., Any], mesh: Mesh) -> Any:
    placed, options = devices.replicated(mesh), devices.compiler_options(mesh)
    return jax.jit(body, donate_argnums=0, out_shardings=placed, compiler_options=options)


def _compiled_beside(program: Any, *like: Any) -> Callable[..., TrainState]:
    """The program, compiled by a thread for arguments like these; its first call waits for it."""
    pool = ThreadPoolExecutor(1, thread_name_prefix="starjax-compile")
    compiled = pool.submit(lambda: program.lower(*like).compile())
    pool.shutdown(wait=False)
    return lambda *args: compiled.result()(*args)
