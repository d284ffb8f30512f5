"""The training step, compiled before the demonstrations exist."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from starjax import config, methods, rcm
from starjax.data import normalizer, windows
from starjax.policies import features
from starjax.policies import policy as policies
from starjax.rcm import arrays
from starjax.runtime import precompile
from starjax.sim import wrists
from starjax.sim.tasks.base import Task
from starjax.training import devices, stepper
from starjax.training import state as states
from starjax.training.sharding import StateLayout
from starjax.training.step import Setup, runs_in_a_loop
from starjax.types import Command, Observation, Pose


@arrays.broadcasting
def step_program(
    method: methods.Method,
    policy_config: config.PolicyConfig,
    train_config: config.TrainConfig,
    task: Task,
    cameras: Sequence[str],
) -> precompile.Program | None:
    """Compiles, in the background, the step that `loop.run` takes with the same arguments.

    Returns None if the dataset is an argument of the program, see `step.runs_in_a_loop`.
    """
    if runs_in_a_loop(policy_config):
        return None
    mesh = devices.make_mesh(train_config.batch_size)
    policy = policies.make(method, policy_config, task, train_config, cameras)
    optimizer = states.make_optimizer(train_config)
    row, by_state = policies.ablated(method, policy_config), policy_config.observation == "state"
    key = jax.random.key(0)
    shapes = states.shapes(
        policy,
        optimizer,
        jax.eval_shape(policy.init, key),
        normalizer.shapes(row, task, by_state),
        key,
        devices.replicated(mesh),
    )
    layout = StateLayout(mesh, policy.cast_params, shapes)
    setup = Setup(policy, optimizer, policy_config, train_config, layout)
    seen = features.select_sensors(task, cameras)
    program = stepper.batch_program(setup)
    batch = batch_shapes(policy_config, train_config.batch_size, seen)
    program.prepare(*stepper.abstract_arguments(setup, batch))
    return program


def batch_shapes(
    policy_config: config.PolicyConfig, batch_size: int, seen: features.Sensors
) -> windows.Batch:
    """Returns shapes of the batches of a training from images or the task's state."""
    task, size = seen.task, policy_config.image_size

    def real(*shape: int) -> Any:
        return jax.ShapeDtypeStruct((batch_size, *shape), jnp.float32)

    def poses(count: int) -> Pose:
        return Pose(real(count, task.arms, 3, 3), real(count, task.arms, 3))

    looks, plans = policy_config.obs_horizon, policy_config.horizon
    bends = any(wrists.per_arm(seen.task))
    observation = Observation(poses(looks), real(looks, task.arms))
    if policy_config.observation == "image":
        picture: Any = jax.ShapeDtypeStruct((batch_size, looks, size, size, 3), jnp.uint8)
        images: dict[str, Any] = dict.fromkeys(seen.cameras, picture)
        observation = observation._replace(images=images)
    else:
        observation = observation._replace(state=real(looks, task.state_size))
    if bends:
        observation = observation._replace(wrist=real(looks, task.arms, 2))
    trocar = rcm.Trocar(*[real(task.arms)] * 3)
    frames = jax.eval_shape(rcm.trocar_frame, trocar, real(task.arms, 3), real(task.arms))
    angles = real(plans, task.arms, 2) if bends else None
    command = Command(poses(plans), real(plans, task.arms), angles)
    return windows.Batch(observation, command, frames)
