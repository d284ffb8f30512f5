"""The endoscope's frame: there and back, and the law that it is for.

If patient, tools and endoscope are moved together, a policy in that frame moves its commands alike.
"""

import dataclasses

import fakes
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.spatial.transform import Rotation

from starjax import config, rcm
from starjax.data import frames, normalizer, windows
from starjax.methods import METHODS
from starjax.policies import policy as policies
from starjax.sim import endoscope_camera, workspaces
from starjax.types import Command, Pose

SCOPE = workspaces.BOARD_ENDOSCOPE
ARMS = 2
TASK = fakes.task(ARMS, endoscope=SCOPE, cameras=(endoscope_camera.NAME,))
FRAMES = np.arange(80)
SIZE = fakes.TINY.image_size


def jit(fn):
    # these programs run once: compiling them badly is fast
    return jax.jit(fn, compiler_options={"xla_backend_optimization_level": 0})


@pytest.fixture(scope="module")
def dataset():
    """Demonstrations that see through an endoscope, of which each episode has its own."""
    found = fakes.dataset(seed=0, demos=4, length=20, image_size=SIZE, arms=ARMS)
    keys = jax.random.split(jax.random.key(3), 4)
    held = jax.vmap(lambda key: endoscope_camera.draw(SCOPE, key))(keys)
    seen = found.observation
    seen = seen._replace(
        images={endoscope_camera.NAME: seen.images["camera"]},
        endoscope=jax.tree.map(lambda leaf: leaf[found.episode], held),
    )
    return found.replace(observation=seen)


@pytest.fixture(scope="module")
def motion():
    """Somewhere else, turned any way."""
    R = Rotation.from_rotvec(jnp.array([0.7, -0.4, 1.1])).as_matrix()
    return Pose(R, jnp.array([0.3, -0.2, 0.1]))


def moved(motion, pose):
    return frames.outward(motion, pose)


def moved_batch(motion, batch):
    """Patient, tools, trocars and endoscope moved together; parameters of a trocar are the
    world's, so they are left as they are, and nobody may look at them."""
    seen, told, asked = batch.observation, batch.trocar, batch.command
    state = np.asarray(seen.state)
    points = [state[..., i : i + 3] for i in (0, 3, 6, 9)]
    R = np.asarray(motion.R)
    is_point = (True, False, False, True)
    turned = [p @ R.T + at * np.asarray(motion.p) for p, at in zip(points, is_point, strict=True)]
    at = moved(motion, Pose(told.R_world_trocar, told.p_world_trocar))
    return batch.replace(
        observation=seen._replace(
            pose=moved(motion, seen.pose),
            endoscope=moved(motion, seen.endoscope),
            state=jnp.asarray(np.concatenate(turned, -1), jnp.float32),
        ),
        command=Command(moved(motion, asked.pose), asked.gripper),
        trocar=told._replace(p_world_trocar=at.p, R_world_trocar=at.R),
    )


def test_there_and_back_is_where_it_was(dataset):
    camera, pose = dataset.observation.endoscope, dataset.command.pose
    back = frames.outward(camera, frames.inward(camera, pose))
    np.testing.assert_allclose(back.p, pose.p, atol=1e-6)
    np.testing.assert_allclose(back.R, pose.R, atol=1e-6)
    there = frames.inward(camera, camera)
    np.testing.assert_allclose(there.R, np.broadcast_to(np.eye(3), there.R.shape), atol=1e-6)
    np.testing.assert_allclose(there.p, 0.0, atol=1e-7)


def test_shafts_pass_their_trocars_in_either_frame(dataset):
    camera, told = dataset.observation.endoscope, dataset.trocar
    of_frame = jax.tree.map(lambda leaf: leaf[dataset.episode], told)
    seen = frames.trocar(TASK, camera, of_frame)
    pose = frames.inward(camera, dataset.command.pose)
    assert rcm.rcm_error(pose, seen.p_world_trocar).max() < 1e-6
    # Rolls stay away from their wrap, of an arm on either side.
    command = rcm.ACTION_SPACES["rcm4"].encode(pose, seen)[..., 0]
    world = rcm.ACTION_SPACES["rcm4"].encode(dataset.command.pose, of_frame)[..., 0]
    assert jnp.abs(command - world).max() < 1.3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "observation"), [("stardiff", "image"), ("stardiff", "state"), ("dp_rcm2", "image")]
)
def test_what_is_moved_together_changes_nothing(dataset, motion, name, observation):
    settings = dataclasses.replace(fakes.TINY, observation=observation, frame="camera")
    stats = normalizer.fit(METHODS[name], TASK, dataset, FRAMES, "camera")
    train = config.TrainConfig(state_noise=0.0)
    policy = policies.make(METHODS[name], settings, TASK, train, TASK.cameras)
    batch = windows.gather(dataset, jnp.array([3, 25, 70]), 2, 16)
    other = moved_batch(motion, batch)
    params = jit(policy.init)(jax.random.key(0))
    keys = jax.random.split(jax.random.key(1), 3)
    sample = jit(policy.sample)
    said = sample(params, stats, keys, batch.observation, batch.trocar)
    again = sample(params, stats, keys, other.observation, other.trocar)
    wanted = moved(motion, said.pose)
    np.testing.assert_allclose(again.pose.p, wanted.p, atol=2e-5)
    np.testing.assert_allclose(again.pose.R, wanted.R, atol=2e-4)
    np.testing.assert_allclose(again.gripper, said.gripper, atol=1e-4)
    trocar = batch.trocar.p_world_trocar[:, None]
    assert rcm.rcm_error(said.pose, trocar).max() < 1e-6
    prepared = jit(policy.prepare)
    first, second = (prepared(stats, jax.random.key(2), x) for x in (batch, other))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=2e-4), first, second)


def test_the_worlds_frame_does_not_have_this_law(dataset, motion):
    stats = normalizer.fit(METHODS["dp_ee"], TASK, dataset, FRAMES)
    settings = dataclasses.replace(fakes.TINY, observation="image")
    policy = policies.make(METHODS["dp_ee"], settings, TASK, cameras=TASK.cameras)
    batch = windows.gather(dataset, jnp.array([3, 25, 70]), 2, 16)
    other = moved_batch(motion, batch)
    params, keys = jit(policy.init)(jax.random.key(0)), jax.random.split(jax.random.key(1), 3)
    sample = jit(policy.sample)
    said, again = (sample(params, stats, keys, x.observation, x.trocar) for x in (batch, other))
    assert jnp.abs(again.pose.p - moved(motion, said.pose).p).max() > 0.05


@pytest.mark.parametrize("name", ["stardiff", "dp_rcm1"])
def test_statistics_are_those_of_what_the_policy_sees(dataset, motion, name):
    turned = jax.tree.map(lambda leaf: leaf[dataset.episode], dataset.trocar)
    every = windows.Batch(dataset.observation, dataset.command, turned)
    other = moved_batch(motion, every)
    first = jnp.asarray(dataset.start)
    shifted = dataset.replace(
        observation=other.observation,
        command=other.command,
        trocar=jax.tree.map(lambda leaf: leaf[first], other.trocar),
    )
    here, there = (
        normalizer.fit(METHODS[name], TASK, x, FRAMES, "camera") for x in (dataset, shifted)
    )
    scales = [(x.action.low, x.action.high, x.state.low, x.state.high) for x in (here, there)]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=2e-5), *scales)


def test_a_pose_that_was_not_observed_is_asked_for(dataset):
    blind = dataset.replace(observation=dataset.observation._replace(endoscope=None))
    with pytest.raises(ValueError, match="endoscope"):
        normalizer.fit(METHODS["stardiff"], TASK, blind, FRAMES, "camera")
