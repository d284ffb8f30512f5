"""Depth and a second lens by a camera's name."""

import jax
import jax.numpy as jnp
import mistakes
import numpy as np
import pytest

from starjax.data import augment
from starjax.evaluation.disturbances import DISTURBANCES, base
from starjax.policies import features
from starjax.sim import derived_views, env, render, scene
from starjax.sim.state import EnvParams

SIZE = 32
VIEWS = ("camera", "camera_right", "camera_depth")


def test_names_of_views():
    known = ["camera", "side", "cam_right"]
    assert derived_views.parse("camera", known) == ("camera", 0.0, False)
    assert derived_views.parse("camera_depth", known) == ("camera", 0.0, True)
    right = derived_views.parse("side_right_depth", known)
    assert right == ("side", derived_views.BASELINE, True)
    assert derived_views.parse("cam_right", known) == ("cam_right", 0.0, False)  # its own
    for name in derived_views.names(known):
        assert derived_views.parse(name, known).camera in known
    with mistakes.of("camera", "camera_left"):
        scene.name("reach", cameras=["camera_left"])
    with mistakes.of("camera", "endoscope_depth"):  # it is elsewhere in every episode
        scene.name("reach", cameras=["endoscope_depth"])


def test_a_depth_image_holds_the_depth_to_a_tenth_of_a_millimetre():
    depth = np.linspace(derived_views.NEAR, derived_views.FAR, 40_000, dtype=np.float32)
    image = derived_views.encode(jnp.asarray(depth.reshape(200, 200)))
    assert image.dtype == jnp.uint8
    found = derived_views.decode(np.asarray(image)).ravel()
    assert np.abs(found - depth).max() < 1e-4
    jump = np.abs(np.diff(np.asarray(image, int).reshape(-1, 3), axis=0))
    assert jump.max() <= 1  # the waves have no jumps
    beyond = derived_views.encode(jnp.array([[0.0, 2.0**20]]))
    np.testing.assert_allclose(
        derived_views.decode(np.asarray(beyond)), [[derived_views.NEAR, derived_views.FAR]]
    )


def test_depth_is_neither_jittered_nor_disturbed():
    rng = np.random.default_rng(0)
    images = rng.integers(60, 200, (1, 2, 2, SIZE, SIZE, 3), np.uint8)  # two steps, two cameras
    sensors = features.Sensors(None, ("camera", "camera_depth"))
    strength = features._of_colours(0.5, sensors.cameras)
    changed, _ = augment.augment(
        jax.random.key(0), jnp.asarray(images), crop=SIZE, jitter=strength, noise=strength
    )
    plain = augment.center(jnp.asarray(images), crop=SIZE)
    np.testing.assert_allclose(changed[:, :, 1], plain[:, :, 1], atol=1e-6)
    assert np.abs(changed[:, :, 0] - plain[:, :, 0]).max() > 0.1
    assert features._of_colours(0.5, ("camera", "camera_right")) == 0.5

    dark, image = DISTURBANCES.get("darkness"), jnp.asarray(images[0, 0, 0])
    state = base.start("darkness", 0.4, jax.random.key(0))
    step = jnp.zeros((), jnp.int32)
    np.testing.assert_array_equal(base.change_image(dark, state, image, step, "x_depth"), image)
    assert (base.change_image(dark, state, image, step, "x_right") != image).any()


@pytest.mark.slow
def test_views_of_a_scene_are_those_of_the_camera_and_of_one_beside_it():
    made = env.make("reach", image_size=SIZE, cameras=VIEWS)
    trocar = jax.tree.map(lambda field: field[0], made.task.trocars)
    state = jax.jit(made.reset)(jax.random.key(0), EnvParams(trocar))
    images = jax.jit(made.observe)(state).images
    assert {name: image.shape for name, image in images.items()} == dict.fromkeys(
        VIEWS, (SIZE, SIZE, 3)
    )
    assert np.any(images["camera"] != images["camera_right"])

    m = made.scene.mj_model
    depth = derived_views.decode(np.asarray(images["camera_depth"]))
    cloud = derived_views.points(depth, m, "camera_depth")
    inside = (depth > derived_views.NEAR) & (depth < derived_views.FAR - 1e-3)
    # The floor fills the picture's upper corner: the rays meet it at one height.
    corner = cloud[:4, :4][inside[:4, :4]]
    assert len(corner) and np.ptp(corner[:, 2]) < 1e-3 and abs(corner[0, 2]) < 0.02

    # A lens to the right sees near things farther to the left.
    moved = derived_views.displaced(m, derived_views.parse("camera_right", ["camera"]))
    shift = moved.camera("camera").pos - m.camera("camera").pos
    np.testing.assert_allclose(np.linalg.norm(shift), derived_views.BASELINE)
    assert abs(shift @ (0, 1, 0)) == pytest.approx(derived_views.BASELINE)  # along the image's x
    assert callable(render.make(moved, "camera", SIZE, SIZE))
