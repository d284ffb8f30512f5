"""Images drawn from a dataset's states: the recorded ones, to the byte."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.core import errors
from starjax.data import demos, episode_images, load, redraw, schema, store
from starjax.data.placed_images import JoinedImages
from starjax.sim import env as envs
from starjax.sim.rollouts import agent
from starjax.training import randomise

pytestmark = pytest.mark.slow

SMOOTHED = 8  # bytes by which the edges of a moving camera's checkers may differ
SIZE, SETTINGS = 32, schema.DemoSettings(per_trocar=1, seed=3, max_steps=200)


@pytest.fixture(scope="module")
def scene():
    return envs.make("reach", image_size=SIZE, cameras=("camera", "endoscope"))


def collect(root, env):
    trocars = jax.tree.map(lambda x: x[1:3], env.task.trocars)
    expert = agent.from_single(env.task.expert(next(iter(env.task.experts))))
    demos.collect(root, env, expert, trocars, SETTINGS, report=lambda line: None)
    return root


@pytest.fixture(scope="module")
def recorded(scene, tmp_path_factory):
    return collect(tmp_path_factory.mktemp("recorded") / "demos", scene)


@pytest.fixture(scope="module")
def unrecorded(scene, tmp_path_factory):
    """The same episodes without images."""
    return collect(tmp_path_factory.mktemp("unrecorded") / "demos", envs.without_images(scene))


def drawn(root, env):
    """Images that are drawn although they were recorded."""
    records = [store.verify(root, key) for key in store.keys(root)]
    return redraw.images(root, store.read_description(root), records, env)


def test_drawn_images_are_the_recorded_ones(scene, recorded):
    for camera, redrawn in drawn(recorded, scene).items():
        images = load.frames(recorded)[camera].read()
        assert images.std() > 10 and redrawn.shape == images.shape
        np.testing.assert_array_equal(JoinedImages([redrawn]).read(), images)
        rows = np.array([[5, 0], [len(images) - 1, 40]])
        np.testing.assert_array_equal(redrawn[rows], images[rows])


def test_cameras_that_may_move_draw_the_recorded_images_where_they_are(scene, recorded):
    found: Any = load.load(recorded, env=scene, sources=True, report=lambda line: None).dataset
    moving = envs.make("reach", image_size=SIZE, cameras=scene.names.cameras, moving_cameras=True)
    at = np.array([0, 30, 60])
    source = found.sources.at(at, found.episode[at])

    @jax.jit
    def draw(level, source):
        draws = randomise.Draws(jnp.array([level]), jax.random.key(0))
        cameras = jax.vmap(lambda pose: randomise.displace(["camera"], draws, pose))(source.cameras)
        images = jax.vmap(moving.draw)(source._replace(cameras=cameras))
        return {name: image.rgb for name, image in images.items()}

    still, moved = draw(0.0, source), draw(10.0, source)
    for name, image in still.items():
        recorded_bytes = np.asarray(found.observation.images[name][at])
        # The endoscope's pose is drawn for each episode: its camera always moves.
        smoothed = 0 if name == "endoscope" else SMOOTHED
        np.testing.assert_allclose(np.asarray(image).astype(int), recorded_bytes, atol=smoothed)
        assert np.mean(np.abs(np.asarray(moved[name]).astype(int) - image)) > 1.0


@pytest.mark.release
def test_a_dataset_without_images_trains_at_any_size(scene, unrecorded):
    root = unrecorded
    assert not any("image" in name for name in store.read_description(root)["features"])
    other = envs.make("reach", image_size=16, cameras=scene.names.cameras)
    for residency in ("device", "host", "disk"):
        kept = load.load(root, env=other, residency=residency, report=lambda line: None)
        images = (kept.dataset.observation.images or {})[scene.names.cameras[0]]
        assert images.shape[1:] == (16, 16, 3)
        assert np.asarray(images[np.array([3, 7])]).std() > 5


@pytest.mark.release
def test_images_of_moments_are_the_recorded_ones_or_drawn_at_any_size(scene, recorded, unrecorded):
    key, camera = store.keys(recorded)[0], scene.names.cameras[0]
    seen = episode_images.of_episode(recorded, key, [0, 9], 8)
    whole = np.load(recorded / "episodes" / key / f"image_{camera}.npy")
    np.testing.assert_array_equal(seen[camera], whole[[0, 9]])
    for size in (SIZE, 24):
        images = episode_images.of_episode(unrecorded, store.keys(unrecorded)[0], [0, 9], size)
        assert {name: x.shape for name, x in images.items()} == dict.fromkeys(
            scene.names.cameras, (2, size, size, 3)
        )
        if size == SIZE:
            np.testing.assert_array_equal(images[camera], seen[camera])


def test_another_scene_is_refused(scene, recorded):
    records = [store.verify(recorded, key) for key in store.keys(recorded)]
    description = store.read_description(recorded) | {"model": "another"}
    with pytest.raises(errors.UsageError, match="reach"):
        redraw.images(recorded, description, records, scene)


def test_images_follow_from_the_state_unless_recorded_observations_were_disturbed(recorded):
    about = store.read_description(recorded)
    without = about | {"features": {"qpos": about["features"]["qpos"]}}
    assert redraw.is_possible(about) and redraw.is_possible(without)
    moved = {"randomise": {"friction": 0.5, "late_commands": 2.0}}
    assert redraw.is_possible(without | moved)
    assert not redraw.is_possible(about | moved)  # an older version's, perhaps with smoke
    assert not redraw.is_possible(without | {"randomise": {"late_view": 2.0}})


def test_motions_recorded_with_disturbances_have_the_layout_that_images_are_drawn_from(scene):
    from starjax.evaluation.disturbances import base
    from starjax.sim.state import EnvParams

    params = EnvParams(jax.tree.map(lambda x: x[1], scene.task.trocars))
    for key in jax.random.split(jax.random.key(2), 3):
        wrong = base.with_random_levels(scene, {"action_delay": 3.0, "friction": 0.5, "mass": 0.5})
        plain, disturbed = scene.reset(key, params), wrong.reset(key, params)
        same = (plain.layout, plain.cameras), (disturbed.layout, disturbed.cameras)
        jax.tree.map(np.testing.assert_array_equal, *same)
        assert disturbed.wrapper_state
