"""Demonstrations without a simulator: tips on random straight paths, poses on the RCM manifold."""

import functools
import types
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.core import config
from starjax.core.types import Command, Observation, Pose
from starjax.data import normalizer, windows
from starjax.policies import policy_file
from starjax.policies.base import Params, Policy
from starjax.policies.learners.diffusion import DiffusionConfig
from starjax.sim import names
from starjax.sim import task as base

SCENE = names.SceneNames("peg_transfer", ("fr5",), ("grasper",), ("camera",))
P_WORLD_REF = np.array([[0.0, 0.0, 0.15]], np.float32)
OTHER_REF = (0.02, 0.1, 0.16)  # m, of a second arm, that faces the first one

# the smallest networks that are still the real ones
TINY = config.PolicyConfig(
    observation="state",
    image_size=32,
    encoder="small",
    vision_dim=16,
    state_dim=16,
    roll_width=16,
    roll_blocks=1,
    options=DiffusionConfig(unet_channels=(16,), time_dim=16, groups=4, ddim_steps=2),
)


def relative(state: Any, tips: Any) -> jax.Array:
    """For each arm: tip to block in the world's frame and in the block's, and tip to target."""
    state = jnp.asarray(state)[..., None, :]
    to_block, to_target = state[..., :3] - tips, state[..., 9:12] - tips
    block = rcm.rot6d_decode(state[..., 3:9])
    turned = jnp.einsum("...ji,...j->...i", block, to_block, precision="highest")
    found = jnp.concatenate([to_block, turned, to_target], axis=-1) / 0.03
    return found.reshape(*found.shape[:-2], -1)


def task(arms: int = 1, **changed: Any) -> base.Task:
    """A block and where it belongs, in as much of a task as policies look at."""
    slots = (
        base.Slot("board", (0.0, 0.0, 0.15)),
        base.Slot("board", OTHER_REF, roll_zero=float(np.pi)),
    )
    nothing = dict.fromkeys(base.Task._fields)
    given = {
        "name": "peg_transfer",
        "trocars": rcm.Trocar(*(field[:, None] for field in rcm.TROCARS)),
        "is_seen": rcm.IS_SEEN,
        "least_steps": 0,
        "slots": slots[:arms],
        "cameras": ("camera", "wrist"),
        "fields": (
            base.Field("block.p", 3, "point"),
            base.Field("block.R", 6, "rot6d"),
            base.Field("target.p", 3, "point"),
        ),
        "relative": relative,
        "experts": {},
    }
    return base.Task(**{**nothing, **given, **changed})


TASK = task()
TWO_ARMS = task(2)


def env() -> types.SimpleNamespace:
    """As much of an `Env` as training looks at."""
    return types.SimpleNamespace(task=TASK, names=SCENE, p_world_ref=P_WORLD_REF)


def trained(**changed: Any) -> policy_file.Trained:
    """A policy of the first scene as its file holds it; parameters are for the caller to give."""
    box = normalizer.MinMax(-jnp.ones(5), jnp.ones(5))
    given = {
        "method": "stardiff",
        "policy": TINY,
        "train": config.TrainConfig(),
        "params": {},
        "normalizer": normalizer.Normalizer(box, None),
        "scene": SCENE,
        "p_world_ref": ((0.0, 0.0, 0.15),),
        "roll_zero": (0.0,),
    }
    return policy_file.Trained(**{**given, **changed})


def params(policy: Policy) -> Params:
    """Parameters like those that `init` draws, which needs compiling: a roll network says zero."""
    rng = np.random.default_rng(0)

    def draw(path: Any, leaf: jax.ShapeDtypeStruct) -> jax.Array:
        name = jax.tree_util.keystr(path, simple=True, separator="/")
        if name.endswith("/scale"):
            return jnp.ones(leaf.shape, leaf.dtype)
        if name.startswith("roll/params/out/"):
            return jnp.zeros(leaf.shape, leaf.dtype)
        most = 0.1 if leaf.ndim == 1 else 1.0 / np.sqrt(np.prod(leaf.shape[:-1]))
        return jnp.asarray(rng.uniform(-most, most, leaf.shape), leaf.dtype)

    return jax.tree_util.tree_map_with_path(draw, jax.eval_shape(policy.init, jax.random.key(0)))


def told(trocar: rcm.Trocar, arms: int = 1) -> rcm.TrocarFrame:
    """Frames `[..., A]` of trocars `[...]`, the same parameters for every arm of `task(arms)`."""
    slots = task(arms).slots
    return rcm.trocar_frame(
        rcm.Trocar(*(jnp.asarray(field)[..., None] for field in trocar)),
        np.array([slot.p_world_ref for slot in slots], np.float32),
        np.array([slot.roll_zero for slot in slots], np.float32),
    )


@functools.cache
def dataset(
    seed: int, demos: int = 8, length: int = 30, image_size: int = 0, arms: int = 1
) -> windows.Dataset:
    """`drawn` up to rounding, in one program."""
    return jax.jit(lambda: drawn(seed, demos, length, image_size, arms))()


def drawn(seed: int, demos: int, length: int, image_size: int, arms: int) -> windows.Dataset:
    """Each demonstration goes from A to B at constant height; its roll depends on its place. Two
    share a trocar. Further arms go other ways through trocars of their own. Golden files were
    made of these, to the last bit."""
    paths = [
        _paths(jax.random.split(jax.random.key(seed + 1000 * arm), 4), demos, length)
        for arm in range(arms)
    ]
    trocar = jax.tree.map(lambda *fields: jnp.stack(fields, -1), *(path[0] for path in paths))
    slots = task(arms).slots
    frames = rcm.trocar_frame(
        trocar,
        np.array([slot.p_world_ref for slot in slots], np.float32),
        np.array([slot.roll_zero for slot in slots], np.float32),
    )
    action = jnp.stack([path[1] for path in paths], 2)
    per_frame = jax.tree.map(lambda x: x[:, None], frames)
    pose, _ = rcm.ACTION_SPACES["rcm4"].decode(action, per_frame)
    gripper = jnp.stack([path[2] for path in paths], 2)
    images = None
    if image_size:
        size = (demos * length, image_size, image_size, 3)
        key = jax.random.split(jax.random.key(seed), 4)[3]
        images = {"camera": jax.random.randint(key, size, 0, 256, jnp.uint8)}

    def flat(x):
        return x.reshape(demos * length, *x.shape[2:])

    def following(x):
        return flat(jnp.concatenate([x[:, 1:], x[:, -1:]], 1))

    return windows.Dataset(
        observation=Observation(
            pose=Pose(flat(pose.R), flat(pose.p)),
            gripper=flat(gripper),
            images=images,
            state=flat(paths[0][3]),
        ),
        command=Command(Pose(following(pose.R), following(pose.p)), following(gripper)),
        trocar=frames,
        episode=jnp.repeat(jnp.arange(demos, dtype=jnp.int32), length),
        start=jnp.arange(demos, dtype=jnp.int32) * length,
        length=jnp.full(demos, length, jnp.int32),
    )


def _paths(keys: jax.Array, demos: int, length: int) -> tuple[rcm.Trocar, Any, Any, Any]:
    """One arm's trocars `[D]`; actions of `rcm4`, grippers and task states, `[D, T, ...]`."""
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
    gripper = jnp.broadcast_to(jnp.where(along[..., 0] > 0.5, -1.0, 1.0), shape)
    rotation = jnp.broadcast_to(jnp.array([1.0, 0, 0, 0, 1.0, 0]), (*shape, 6))
    ends = [jnp.broadcast_to(x, (*shape, 3)) for x in (end, start)]
    return trocar, action, gripper, jnp.concatenate([ends[0], rotation, ends[1]], -1)
