"""Augmentation: the crop's displacement is exact, noise has its moments, everything is in range."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.data import augment

KEY = jax.random.key(0)
PLAIN = {"jitter": 0.0, "noise": 0.0}


def numbered(n=6, height=40, width=48):
    """Frames whose red is the row and green the column."""
    row, column = np.mgrid[:height, :width]
    frame = np.stack([row, column, np.zeros_like(row)], -1).astype(np.uint8)
    return jnp.asarray(np.broadcast_to(frame, (n, *frame.shape)))


# Compiled as a whole: one by one, the operations take longer to compile.
run = jax.jit(augment.augment, static_argnames=("crop", "jitter", "noise", "dtype"))


def denormalize(x):
    return (x * jnp.array(augment.STD) + jnp.array(augment.MEAN)) * 255.0


def test_offset_says_where_the_crop_is():
    crops, offset = run(KEY, numbered(), crop=32, **PLAIN)
    corner = denormalize(crops)[:, 0, 0, :2]
    np.testing.assert_allclose(corner, offset + np.array([4, 8]), atol=1e-3)
    assert len({tuple(o) for o in np.asarray(offset).tolist()}) > 3  # each frame has its own


def test_the_centre_crop_has_no_offset():
    """Rows and columns of the random crop less its offset are those of the centre crop."""
    for crop in (31, 32):
        crops, offset = run(KEY, numbered(), crop=crop, **PLAIN)
        back = denormalize(crops)[..., :2] - offset[:, None, None, :]
        centre = denormalize(augment.center(numbered(), crop=crop))[..., :2]
        np.testing.assert_allclose(back, centre, atol=1e-3)


def test_every_crop_is_equally_likely():
    _, offset = run(KEY, jnp.zeros((9_000, 4, 4, 3), jnp.uint8), crop=2, **PLAIN)
    _, counts = np.unique(np.asarray(offset), axis=0, return_counts=True)
    assert len(counts) == 9
    assert (np.abs(counts - 1000) < 150).all()


def test_leading_axes_are_kept():
    images = numbered().reshape(2, 3, 40, 48, 3)
    crops, offset = run(KEY, images, crop=32)
    assert crops.shape == (2, 3, 32, 32, 3)
    assert offset.shape == (2, 3, 2)
    assert augment.center(images, crop=32).shape == (2, 3, 32, 32, 3)


def test_full_size_without_jitter_is_normalisation_alone():
    images = numbered(2, 32, 32)
    crops, offset = run(KEY, images, crop=32, **PLAIN)
    np.testing.assert_allclose(crops, augment.center(images, crop=32), atol=1e-5)
    np.testing.assert_array_equal(offset, 0.0)


def test_jitter_stays_within_its_range_and_differs_between_frames():
    images = jnp.full((500, 8, 8, 3), 128, jnp.uint8)
    crops, _ = run(KEY, images, crop=8, jitter=0.2, noise=0.0)
    level = np.asarray(denormalize(crops)).mean((1, 2)) / 255.0
    # Grey keeps its hue, and brightness alone can move it by 0.2 of itself.
    np.testing.assert_allclose(level, level[:, :1].repeat(3, 1), atol=1e-5)
    assert 0.35 < level.min() < 0.43
    assert 0.58 < level.max() < 0.66


def test_saturation_moves_colours_about_their_grey():
    images = jnp.broadcast_to(jnp.array([200, 40, 90], jnp.uint8), (100, 4, 4, 3))
    crops, _ = run(KEY, images, crop=4, jitter=0.3, noise=0.0)
    colour = np.asarray(denormalize(crops))[:, 0, 0]
    spread = (colour[:, 0] - colour[:, 1]) / (colour @ np.array(augment.LUMINANCE))
    assert spread.std() > 0.1


def test_values_stay_in_range_and_finite():
    images = jnp.asarray(np.random.default_rng(1).integers(0, 256, (4, 16, 16, 3)), jnp.uint8)
    crops, _ = run(KEY, images, crop=12, jitter=0.9, noise=0.5)
    pixels = denormalize(crops)
    assert float(pixels.min()) >= -1e-3
    assert float(pixels.max()) <= 255.001


def seeds(key, n):
    return jax.random.bits(key, (n,), jnp.uint32)


def test_hashed_noise_is_nearly_normal():
    x = np.asarray(augment.hash_normal(seeds(KEY, 64), (64, 64, 3)), float)
    assert abs(x.mean()) < 0.005
    assert x.std() == pytest.approx(1.0, abs=0.005)
    assert (x**3).mean() == pytest.approx(0.0, abs=0.02)
    assert (x**4).mean() == pytest.approx(2.7, abs=0.03)


def test_hashed_noise_has_no_pattern():
    """No correlation with the neighbour pixel, channel or frame, nor between keys."""
    x = np.asarray(augment.hash_normal(seeds(KEY, 32), (64, 64, 3)), float)
    other = np.asarray(augment.hash_normal(seeds(jax.random.key(1), 32), (64, 64, 3)), float)
    pairs = [(x[1:], x[:-1]), (x[:, 1:], x[:, :-1]), (x[:, :, 1:], x[:, :, :-1])]
    pairs += [(x[..., 0], x[..., 1]), (x, other)]
    for a, b in pairs:
        assert abs((a * b).mean()) < 0.01
    power = np.abs(np.fft.rfft2(x[..., 0], norm="ortho")) ** 2
    assert power.mean(0).max() < 4.0


def test_noise_depends_on_key_and_is_repeatable():
    images = numbered()
    a, _ = run(KEY, images, crop=32)
    b, _ = run(KEY, images, crop=32)
    c, _ = run(jax.random.key(1), images, crop=32)
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, c)


def test_bfloat16_output():
    assert run(KEY, numbered(), crop=32, dtype=jnp.bfloat16)[0].dtype == jnp.bfloat16
    assert augment.center(numbered(), crop=32, dtype=jnp.bfloat16).dtype == jnp.bfloat16


@pytest.mark.parametrize(
    ("images", "crop", "message"),
    [
        (jnp.zeros((2, 8, 8, 3)), 4, "images: expected uint8"),
        (jnp.zeros((2, 8, 8, 4), jnp.uint8), 4, "images: expected uint8"),
        (jnp.zeros((2, 8, 6, 3), jnp.uint8), 7, r"crop: expected 1\.\.6 pixels, got 7"),
    ],
)
def test_wrong_inputs_are_named(images, crop, message):
    with pytest.raises(ValueError, match=message):
        augment.augment(KEY, images, crop=crop)
    with pytest.raises(ValueError, match=message):
        augment.center(images, crop=crop)


def test_pixel_noise_has_its_deviation_and_is_another_in_every_frame():
    crops, _ = run(KEY, jnp.full((2, 64, 64, 3), 128, jnp.uint8), crop=64, jitter=0.0, noise=0.05)
    x = np.asarray(denormalize(crops)) / 255.0 - 128 / 255
    np.testing.assert_allclose(x.std((1, 2, 3)), 0.05, rtol=0.03)
    assert abs((x[0] * x[1]).mean()) < 0.1 * 0.05**2


def test_contrast_moves_values_about_mid_grey():
    halves = jnp.where(jnp.arange(8)[:, None, None] < 4, 64, 192) * jnp.ones((200, 8, 8, 3))
    crops, _ = run(KEY, halves.astype(jnp.uint8), crop=8, jitter=0.1, noise=0.0)
    low, high = np.asarray(denormalize(crops))[:, [0, -1], 0, 0].T
    assert ((high - low) / (high + low)).std() > 0.02  # brightness alone leaves this ratio


def test_normalisation_is_imagenets():
    white = jnp.full((2, 2, 3), 255, jnp.uint8)
    np.testing.assert_allclose(
        augment.center(white, crop=1)[0, 0], [2.2489, 2.4286, 2.64], atol=1e-4
    )
