"""Many training steps in a row, of a state as `Parts` carries it."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh

from starjax import config
from starjax.data import windows
from starjax.policies.base import Policy
from starjax.runtime import background, garbage, processes
from starjax.training import devices, prefetch
from starjax.training import step as steps
from starjax.training.sharding import Carried, Parts
from starjax.training.state import TrainState


class Advance(NamedTuple):
    """What training calls.

    Attributes:
      begin: what is carried, of a state, whose memory the steps may reuse.
      several: so many steps `(carried, count) -> carried`, in the given memory.
      end: the state of what is carried, whose memory further steps may reuse.
    """

    begin: Callable[[TrainState], Carried]
    several: Callable[[Carried, int], Carried]
    end: Callable[[Carried], TrainState]


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


def resident(it: Training, like: TrainState, ahead: bool) -> Advance:
    """Steps on a dataset that is on the device, and is copied to every device of the mesh.

    `like` has shapes and places of the state. `ahead`: the program is traced now, and compiled
    beside what the caller does until the first step.
    """
    data = devices.replicate((it.dataset, jnp.asarray(it.frames)), it.mesh, may_alias=None)
    parts = Parts(it.mesh, it.policy.rounded, like)
    settings = (it.policy, it.optimizer, it.policy_config, it.train_config, parts)
    looped = steps.runs_in_a_loop(it.policy_config)
    body = steps.resident_steps if looped else steps.resident_step
    program = _program(functools.partial(body, *settings), parts)

    def counted(count: int) -> tuple[jax.Array, ...]:
        return (devices.replicate(np.int32(count), it.mesh),) if looped else ()

    if ahead:
        program = _compiled_in_background(program, parts.carried(), *data, *counted(1))

    def several(carried: Carried, count: int) -> Carried:
        for _ in range(1 if looped else count):
            carried = program(carried, *data, *counted(count))
        return carried

    return _advance(parts, several)


def streamed(it: Training, state: TrainState) -> Advance:
    """Steps on a dataset of the host, whose batches follow this state's."""
    parts = Parts(it.mesh, it.policy.rounded, jax.eval_shape(lambda x: x, state))
    settings = (it.policy, it.optimizer, it.train_config, parts)
    program = _program(functools.partial(steps.train_step, *settings), parts)
    key = jnp.copy(processes.own(state.key))
    stream = prefetch.batches(
        it.dataset, it.frames, it.policy_config, it.train_config, it.mesh, key, int(state.step)
    )

    def several(carried: Carried, count: int) -> Carried:
        for _ in range(count):
            carried = program(carried, next(stream))
        return carried

    return _advance(parts, several)


def _advance(parts: Parts, several: Callable[[Carried, int], Carried]) -> Advance:
    if parts.mesh.size == 1:  # matrices stay where they are
        return Advance(parts.begin, several, parts.end)
    begin = jax.jit(parts.begin, out_shardings=parts.placed())
    return Advance(begin, several, jax.jit(parts.end, out_shardings=devices.replicated(parts.mesh)))


def _program(body: Callable[..., Any], parts: Parts) -> Any:
    options = devices.compiler_options(parts.mesh)
    return jax.jit(body, donate_argnums=0, out_shardings=parts.placed(), compiler_options=options)


def _compiled_in_background(program: Any, *like: Any) -> Callable[..., Carried]:
    """The program, compiled by a thread for arguments like these; its first call waits for it."""
    # Traced here: by a thread it would take turns with what the caller does, both in Python.
    with garbage.gc_paused():
        lowered = program.lower(*like)
    compiled = background.run_in_background(lowered.compile)
    return lambda *args: compiled()(*args)
