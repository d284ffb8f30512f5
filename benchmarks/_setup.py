"""What the benchmarks train and call: the paper's model on a GPU, a small one on a CPU."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.core.config import PolicyConfig, TrainConfig
from starjax.core.methods import METHODS
from starjax.core.types import Command, Observation, Pose
from starjax.data import normalizer, windows
from starjax.policies import features
from starjax.policies import policy as policies
from starjax.policies.learners.diffusion import DiffusionConfig
from starjax.sim import registries
from starjax.training import devices, state, step
from starjax.training.sharding import Setup, StateLayout, StepCarry

TASK = registries.tasks.get("peg_transfer")
P_WORLD_REF = np.array([slot.p_world_ref for slot in TASK.slots], np.float32)
METHOD = METHODS["stardiff"]

IMAGE = {96: 108, 224: 256}  # side of the stored picture for each crop
SMALL = PolicyConfig(
    observation="state",
    encoder="small",
    vision_dim=128,
    options=DiffusionConfig(unet_channels=(64, 128, 256), time_dim=64),
)
MINIATURE = dataclasses.replace(
    SMALL,
    vision_dim=32,
    state_dim=32,
    options=DiffusionConfig(unet_channels=(32, 64), time_dim=32),
)


class Case(NamedTuple):
    """Settings of one row."""

    policy: PolicyConfig
    train: TrainConfig

    @property
    def crop(self) -> int:
        """Side of the crop in pixels, 0 without pictures."""
        sees = self.policy.observation == "image"
        return features.crop_size(self.policy) if sees else 0


class Job(NamedTuple):
    """A training run ready to be timed.

    Attributes:
      policy: being trained.
      params: shapes of its parameters, as the networks take them.
      carry: state from call to call, on all devices.
      dataset: made-up frames on all devices.
      example: a batch.
      steps: (carry, dataset, count) -> carry after `per_call` steps.
      per_call: steps in one call; `count` must be given as this.
      options: of `jax.jit` for `steps`, as training has them.
      calls: made before the last one's result is waited for, as training does.
    """

    policy: policies.Policy
    params: policies.Params
    carry: StepCarry
    dataset: windows.Dataset
    example: windows.Batch
    steps: Callable[..., StepCarry]
    per_call: int
    options: dict[str, Any]
    calls: int


def paper(crop: int, batch: int = 256, dtype: str = "bfloat16") -> Case:
    """The paper's networks (ResNet-18, U-Net 256-512-1024-2048) on crops of this side."""
    size = IMAGE[crop]
    policy_config = PolicyConfig(image_size=size, crop_fraction=crop / size, dtype=dtype)
    return Case(policy_config, TrainConfig(batch_size=batch))


def small(batch: int, image_size: int = 0) -> Case:
    """A model for two cores: of the task's state, or of pictures of this side."""
    return looking(Case(SMALL, TrainConfig(batch_size=batch)), image_size)


def miniature(batch: int = 4, image_size: int = 54) -> Case:
    """To see in seconds that a benchmark runs."""
    policy_config = dataclasses.replace(MINIATURE, crop_fraction=48 / 54)
    return looking(Case(policy_config, TrainConfig(batch_size=batch)), image_size)


def looking(case: Case, image_size: int) -> Case:
    """The case with pictures of this side as its observations, or with the task's state (0)."""
    seen = {"observation": "image", "image_size": image_size} if image_size else {}
    changed = dataclasses.replace(case.policy, **(seen or {"observation": "state"}))
    return case._replace(policy=changed)


def job(case: Case, on: Sequence[jax.Device] | None = None, seed: int = 0, frames: int = 0) -> Job:
    """The case's training on the given devices (default: the first one)."""
    on = jax.devices()[:1] if on is None else on
    policy = policies.make(METHOD, case.policy, TASK, case.train)
    optimizer = state.make_optimizer(case.train)
    count = frames or (512 if on[0].platform == "cpu" else 4096)
    dataset = made_up(case.policy, count)
    batch = case.train.batch_size
    frame = jnp.arange(batch) % count
    example = windows.gather(dataset, frame, case.policy.obs_horizon, case.policy.horizon)
    stats, key = statistics(case.policy), state.streams(seed).steps
    first = state.create(policy, optimizer, drawn(policy, seed), stats, key)
    mesh = devices.make_mesh(batch, on)
    shapes = jax.eval_shape(lambda x: x, first)
    layout = StateLayout(mesh, policy.cast_params, shapes)
    setup = Setup(policy, optimizer, case.policy, case.train, layout)
    looped = step.runs_in_a_loop(case.policy)

    def steps(carry, dataset, count):
        drawn = jnp.arange(len(dataset.episode))
        available = jnp.int32(len(drawn))
        if looped:
            return step.resident_steps(setup, carry, dataset, drawn, available, count)
        return step.resident_step(setup, carry, dataset, drawn, available)

    first, dataset = devices.replicate((first, dataset), mesh)
    carry = jax.jit(layout.to_carry, out_shardings=layout.shardings())(first)
    options = {
        "out_shardings": layout.shardings(),
        "compiler_options": devices.compiler_options(mesh),
    }
    per_call, calls = (10, 1) if looped else (1, 50 if on[0].platform == "gpu" else 1)
    return Job(policy, shapes.params, carry, dataset, example, steps, per_call, options, calls)


def untrained(case: Case) -> tuple[policies.Policy, Any, normalizer.Normalizer]:
    """A policy, its first parameters as an evaluation holds them, and its statistics."""
    policy = policies.make(METHOD, case.policy, TASK, case.train)
    params = policy.prepare_for_inference(drawn(policy))
    return policy, params, statistics(case.policy)


def drawn(policy: policies.Policy, seed: int = 0) -> policies.Params:
    """A policy's first parameters, on the device."""
    return state.on_device(state.init(policy, state.streams(seed).params).drawn())


def statistics(policy_config: PolicyConfig) -> normalizer.Normalizer:
    """For commands that are in [-1, 1] already."""
    box = normalizer.MinMax(-jnp.ones(5), jnp.ones(5))
    wide = normalizer.MinMax(-jnp.ones(TASK.state_size), jnp.ones(TASK.state_size))
    return normalizer.Normalizer(box, wide if policy_config.observation == "state" else None)


@functools.lru_cache(maxsize=1)
def made_up(policy_config: PolicyConfig, count: int) -> windows.Dataset:
    """One long demonstration on the device; its values do not change the time.

    Made by numpy: no program is compiled for data from a disk.
    """
    images = state = None
    if policy_config.observation == "image":
        size = (count, policy_config.image_size, policy_config.image_size, 3)
        images = {TASK.cameras[0]: np.random.default_rng(0).integers(0, 256, size, np.uint8)}
    else:
        state = np.full((count, TASK.state_size), 0.5, np.float32)
    down = np.tile(np.diag([1.0, -1.0, -1.0]).astype(np.float32), (count, 1, 1, 1))
    pose = Pose(down, np.full((count, 1, 3), 0.02, np.float32))
    gripper = np.ones((count, 1), np.float32)
    dataset = windows.Dataset(
        observation=Observation(pose, gripper, images, state),
        command=Command(pose, gripper),
        trocar=jax.tree.map(
            np.asarray,
            rcm.trocar_frame(jax.tree.map(lambda leaf: leaf[:1], TASK.trocars), P_WORLD_REF),
        ),
        episode=np.zeros(count, np.int32),
        start=np.zeros(1, np.int32),
        length=np.full(1, count, np.int32),
    )
    return jax.device_put(dataset, jax.local_devices()[0])
