"""Demonstrations without a simulator: tips on random straight paths, poses on the RCM manifold."""

import jax
import jax.numpy as jnp
import numpy as np
from starjax.sim.types import Observation

from starjax import config, rcm
from starjax.data import windows
from starjax.types import Command, Pose

P_WORLD_REF = np.array([0.0, 0.0, 0.15], np.float32)

# the smallest networks that are still the real ones
TINY = config.PolicyConfig(
    observation="state",
    image_size=32,
    encoder="small",
    vision_dim=16,
    state_dim=16,
    unet_channels=(16,),
    time_dim=16,
    groups=4,
    roll_width=16,
    roll_blocks=1,
    ddim_steps=2,
)


def dataset(seed: int, demos: int = 8, length: int = 30, image_size: int = 0) -> windows.Dataset:
    """Each demonstration goes from A to B at constant height; its roll depends on where it is. Two
    share a trocar."""
    keys = jax.random.split(jax.random.key(seed), 4)
    shape = (demos, length)
    drawn = rcm.sample_trocar(keys[0], (-(-demos // 2),))
    trocar = jax.tree.map(lambda field: jnp.repeat(field, 2)[:demos], drawn)
    start = jax.random.uniform(keys[1], (demos, 1, 3), minval=-0.03, maxval=0.03)
    end = jax.random.uniform(keys[2], (demos, 1, 3), minval=-0.03, maxval=0.03)
    height = jnp.array([0.0, 0.0, 1.0])
    start, end = start * (1 - height), end * (1 - height)
    along = jnp.linspace(0.0, 1.0, length)[None, :, None]
    p = start + (end - start) * along + jnp.array([0.0, 0.0, 0.03]) + 0.01 * along * height
    roll = jnp.sin(40.0 * p[..., 0]) + 10.0 * p[..., 1]
    action = jnp.concatenate([roll[..., None], p], -1)
    per_frame = jax.tree.map(lambda x: x[:, None], trocar)
    pose, _ = rcm.ACTION_SPACES["rcm4"].decode(action, per_frame, P_WORLD_REF)
    gripper = jnp.broadcast_to(jnp.where(along[..., 0] > 0.5, -1.0, 1.0), shape)
    rotation = jnp.broadcast_to(jnp.array([1.0, 0, 0, 0, 1.0, 0]), (*shape, 6))
    ends = [jnp.broadcast_to(x, (*shape, 3)) for x in (end, start)]
    state = jnp.concatenate([ends[0], rotation, ends[1]], -1)
    image = None
    if image_size:
        size = (demos * length, image_size, image_size, 3)
        image = jax.random.randint(keys[3], size, 0, 256, jnp.uint8)

    def flat(x):
        return x.reshape(demos * length, *x.shape[2:])

    def following(x):
        return flat(jnp.concatenate([x[:, 1:], x[:, -1:]], 1))

    return windows.Dataset(
        observation=Observation(
            pose=Pose(flat(pose.R), flat(pose.p)),
            gripper=flat(gripper),
            image=image,
            state=flat(state),
        ),
        command=Command(Pose(following(pose.R), following(pose.p)), following(gripper)),
        trocar=trocar,
        episode=jnp.repeat(jnp.arange(demos, dtype=jnp.int32), length),
        start=jnp.arange(demos, dtype=jnp.int32) * length,
        length=jnp.full(demos, length, jnp.int32),
    )
