"""The training step, compiled before the demonstrations exist."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.core import config, methods
from starjax.core.types import Command, Observation, Pose
from starjax.data import normalizer, windows
from starjax.policies import features
from starjax.policies import policy as policies
from starjax.rcm import arrays
from starjax.runtime import precompile
from starjax.sim import wrists
from starjax.sim.task import Task
from starjax.training import devices
from starjax.training import state as states
from starjax.training import step as steps
from starjax.training.sharding import Setup, StateLayout


@arrays.broadcasting
def step_program(
    method: methods.Method,
    policy_config: config.PolicyConfig,
    train_config: config.TrainConfig,
    task: Task,
    cameras: Sequence[str],
    demos: int = 0,
    rows: int = 0,
) -> precompile.Program | None:
    """Compiles, in the background, the steps that `loop.run` takes with the same arguments.

    Args:
      method, policy_config, train_config, task, cameras: as for `loop.run`.
      demos: number of demonstrations.
      rows: frames that their dataset has room for, see `load.load`.

    Returns:
      the program; None if it depends on a dataset (`step.runs_in_a_loop`) whose size is unknown.
    """
    loops = steps.runs_in_a_loop(policy_config)
    if loops and not rows:
        return None
    mesh = devices.make_mesh(train_config.batch_size)
    policy = policies.make(method, policy_config, task, train_config, cameras)
    optimizer = states.make_optimizer(train_config)
    row, by_state = policies.ablated(method, policy_config), policy_config.observation == "state"
    key = jax.random.key(0)
    shapes = states.shapes(
        policy,
        optimizer,
        precompile.Program(policy.init).shapes(key),
        normalizer.shapes(row, task, by_state),
        key,
        devices.replicated(mesh),
    )
    layout = StateLayout(mesh, policy.cast_params, shapes)
    setup = Setup(policy, optimizer, policy_config, train_config, layout)
    seen = features.select_sensors(task, cameras)
    if loops:
        program = steps.loop_program(setup)
        dataset = dataset_shapes(policy_config, demos, rows, seen)
        program.prepare(*steps.loop_arguments(setup, dataset))
    else:
        program = steps.batch_program(setup)
        batch = batch_shapes(policy_config, train_config.batch_size, seen)
        program.prepare(*steps.batch_arguments(setup, batch))
    return program


def batch_shapes(
    policy_config: config.PolicyConfig, batch_size: int, seen: features.Sensors
) -> windows.Batch:
    """Returns shapes of the batches of a training from images or the task's state."""
    looks, plans = (batch_size, policy_config.obs_horizon), (batch_size, policy_config.horizon)
    return windows.Batch(*_shapes(policy_config, seen, looks, plans, batch_size))


def dataset_shapes(
    policy_config: config.PolicyConfig, demos: int, rows: int, seen: features.Sensors
) -> windows.Dataset:
    """Returns shapes of the dataset of a training from features or the task's state."""
    episode, each = (jax.ShapeDtypeStruct((n,), jnp.int32) for n in (rows, demos))
    return windows.Dataset(
        *_shapes(policy_config, seen, (rows,), (rows,), demos), episode, each, each
    )


def _shapes(
    policy_config: config.PolicyConfig,
    seen: features.Sensors,
    observed: tuple[int, ...],
    commanded: tuple[int, ...],
    trocars: int,
) -> tuple[Observation, Command, rcm.TrocarFrame]:
    """Returns shapes of observations, commands and trocars with these leading axes."""
    task, size = seen.task, policy_config.image_size

    def real(*shape: int) -> Any:
        return jax.ShapeDtypeStruct(shape, jnp.float32)

    def poses(lead: tuple[int, ...]) -> Pose:
        return Pose(real(*lead, task.arms, 3, 3), real(*lead, task.arms, 3))

    bends = any(wrists.per_arm(seen.task))
    observation = Observation(poses(observed), real(*observed, task.arms))
    if policy_config.observation != "image":
        observation = observation._replace(state=real(*observed, task.state_size))
    elif policy_config.freeze_encoder:
        width = policy_config.vision_dim * len(seen.cameras)
        observation = observation._replace(features=real(*observed, width))
    else:
        picture: Any = jax.ShapeDtypeStruct((*observed, size, size, 3), jnp.uint8)
        images: dict[str, Any] = dict.fromkeys(seen.cameras, picture)
        observation = observation._replace(images=images)
    if bends:
        observation = observation._replace(wrist=real(*observed, task.arms, 2))
    trocar = rcm.Trocar(*[real(trocars, task.arms)] * 3)
    frames = jax.eval_shape(
        rcm.trocar_frame, trocar, real(trocars, task.arms, 3), real(trocars, task.arms)
    )
    angles = real(*commanded, task.arms, 2) if bends else None
    return observation, Command(poses(commanded), real(*commanded, task.arms), angles), frames
