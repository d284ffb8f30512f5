"""Depth views as point clouds, and networks of their own for them."""

import dataclasses

import fakes
import jax
import jax.numpy as jnp
import mistakes
import numpy as np
import pytest

from starjax.core import methods
from starjax.data import augment
from starjax.policies import features, generator, point_encoder
from starjax.sim import derived_views

SIZE, CROP = 24, 16
VIEWS = features.Sensors(fakes.TASK, ("camera", "camera_depth"))
SETTINGS = dataclasses.replace(
    fakes.TINY, observation="image", image_size=CROP, vision_dim=16, depth_encoder="points"
)


@pytest.fixture(scope="module")
def depth():
    return np.random.default_rng(0).uniform(0.2, 0.5, (3, SIZE, SIZE)).astype(np.float32)


@pytest.fixture(scope="module")
def views(depth):
    return derived_views.encode(jnp.asarray(depth))


def test_points_are_rays_times_the_depth(depth, views):
    cut = slice((SIZE - CROP) // 2, (SIZE + CROP) // 2)
    points = point_encoder.back_projected(augment.center(views, crop=CROP))
    z = depth[:, cut, cut][:, 1::2, 1::2]
    side = (np.arange(1, CROP, 2) + 0.5) / (CROP / 2) - 1
    expected = np.stack([side[:, None] * z, side * z, z - 0.35], axis=-1) / 0.1
    np.testing.assert_allclose(points, expected.reshape(3, -1, 3), atol=2e-3)  # depth of 10 cm


def test_a_displaced_crop_has_the_same_points_where_both_see(views):
    at = (SIZE - CROP) // 2
    centre = point_encoder.back_projected(augment.center(views, crop=CROP))
    moved = augment.center(views[:, at + 2 : at + 2 + CROP, at - 4 : at - 4 + CROP], crop=CROP)
    moved = point_encoder.back_projected(moved, jnp.tile(jnp.array([[2.0, -4.0]]), (3, 1)))
    cells = CROP // 2
    centre, moved = (p.reshape(3, cells, cells, 3) for p in (centre, moved))
    np.testing.assert_allclose(moved[:, :-1, 2:], centre[:, 1:, :-2], atol=1e-5)


def made(settings, sensors=VIEWS):
    return generator.make(methods.METHODS["stardiff"], settings, sensors, 4)


def seen(model, params, images):
    history = jnp.zeros((1, 2, features.history_dim(SETTINGS, fakes.TASK, 4)))
    inputs = features.Inputs(history, images)
    return model.observe(params, inputs, jnp.zeros((1, 0))).vision


def test_colours_and_depth_have_networks_of_their_own(views):
    model = made(SETTINGS)
    params = jax.jit(model.init)(jax.random.key(0))
    assert {"vision", "depth"} < set(params)
    images = jnp.zeros((1, 2, 2, CROP, CROP, 3))
    cut = augment.center(views[:1], crop=CROP)
    see = jax.jit(lambda images: seen(model, params, images))
    before, after = (see(x) for x in (images, images.at[:, :, 1].set(cut)))
    assert before.shape == (1, 2, 2 * SETTINGS.vision_dim)
    np.testing.assert_array_equal(*(x[..., : SETTINGS.vision_dim] for x in (before, after)))
    assert np.abs(before - after)[..., SETTINGS.vision_dim :].max() > 1e-3
    # Without the setting one network reads both.
    both = made(dataclasses.replace(SETTINGS, depth_encoder=""))
    assert "depth" not in jax.eval_shape(both.init, jax.random.key(0))


def test_an_encoder_of_depth_is_refused_for_colours_and_reads_depth_alone():
    settings = dataclasses.replace(SETTINGS, encoder="points", depth_encoder="")
    with mistakes.of("policy.encoder", "points"):
        made(settings)
    alone = made(settings, features.Sensors(fakes.TASK, ("camera_depth",)))
    params = jax.jit(alone.init)(jax.random.key(0))
    assert "depth" not in params
    trunk = params["vision"]["params"]["trunk"]
    cast = made(
        dataclasses.replace(settings, dtype="bfloat16"), VIEWS._replace(cameras=("camera_depth",))
    ).cast_params(params)
    assert cast["vision"]["params"]["trunk"]["Dense_0"]["kernel"].dtype == jnp.bfloat16
    assert trunk["Dense_0"]["kernel"].shape == (3, point_encoder.POINTS.width)
