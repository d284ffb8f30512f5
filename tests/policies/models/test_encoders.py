"""Encoders: keypoints in the uncropped picture, per-frame independence, shapes, gradients."""
# pyright: reportArgumentType=false, reportCallIssue=false, reportOperatorIssue=false

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.core.learners import ENCODERS
from starjax.policies.models import encoders, layers, resnet, spatial_softmax
from starjax.policies.models.group_norm import GroupNorm

KEY = jax.random.key(0)


def make(trunk, **changes):
    settings = {"features": 8, "width": 16}
    return encoders.make(trunk, **{**settings, **changes})


def normal(*shape):
    return jnp.asarray(np.random.default_rng(1).normal(size=shape), jnp.float32)


def frames(n=2, size=64):
    return normal(n, size, size, 3)


@pytest.mark.parametrize(("row", "column"), [(0, 0), (2, 5), (3, 7)])
def test_a_peak_is_at_its_cells_centre(row, column):
    logits = jnp.zeros((1, 4, 8, 1)).at[0, row, column, 0].set(100.0)
    point = spatial_softmax.spatial_softmax(logits, (64, 128))[0, 0]
    # In pixels of a 64 x 128 image, cells are 16 pixels: the centre of cell i is at 16 i + 8.
    pixel = (np.asarray(point) + 1.0) / 2.0 * np.array([64, 128])
    np.testing.assert_allclose(pixel, [16 * row + 8, 16 * column + 8], atol=1e-3)


def test_flat_maps_look_at_the_centre():
    points = spatial_softmax.spatial_softmax(jnp.ones((2, 5, 5, 3)), (10, 10))
    np.testing.assert_allclose(points, 0.0, atol=1e-6)


def test_a_crop_does_not_move_a_keypoint():
    """A peak in an 8 x 8 map of 64 pixels, seen through crops of 32 pixels."""
    full = jnp.zeros((8, 8)).at[3, 4].set(100.0)
    seen = []
    for top, left in ((0, 1), (2, 2), (3, 3), (0, 4)):
        crop = full[top : top + 4, left : left + 4][None, ..., None]
        offset = jnp.array([[8.0 * top - 16.0, 8.0 * left - 16.0]])
        seen.append(spatial_softmax.spatial_softmax(crop, (32, 32), offset)[0, 0])
    for point in seen[1:]:
        np.testing.assert_allclose(point, seen[0], atol=1e-5)
    np.testing.assert_allclose(seen[0], [(3 * 8 + 4 - 32) / 16, (4 * 8 + 4 - 32) / 16], atol=1e-5)


@pytest.fixture(scope="module", params=sorted(ENCODERS.built_in))
def encoder(request):
    """An encoder's parameters, its output and the gradient of its first frame's output."""
    module = make(request.param)
    params = jax.jit(module.init)(KEY, frames())

    def first(params, images):
        out = module.apply(params, images, jnp.zeros((2, 2)))
        return (out[0] ** 2).sum(), out

    program = jax.jit(jax.value_and_grad(first, (0, 1), has_aux=True))
    (_, out), gradients = program(params, frames())
    return request.param, params, out, gradients


def test_every_parameter_gets_a_gradient(encoder):
    _, _, out, (gradient, _) = encoder
    assert out.shape == (2, 8)
    for path, leaf in jax.tree_util.tree_leaves_with_path(gradient):
        assert jnp.isfinite(leaf).all(), path
        assert (leaf != 0).any(), path


def test_frames_do_not_see_each_other(encoder):
    _, _, _, (_, by_image) = encoder
    assert (by_image[0] != 0).any()
    np.testing.assert_array_equal(by_image[1], 0.0)


def test_bfloat16_is_close(encoder):
    trunk, params, exact, _ = encoder
    rough = jax.jit(make(trunk, dtype=jnp.bfloat16).apply)(params, frames())
    assert rough.dtype == jnp.float32
    assert 0 < float(jnp.abs(rough - exact).max()) < 0.1 * float(jnp.abs(exact).max())


def test_resnet18_has_torchvisions_size():
    shapes = jax.eval_shape(resnet.ResNet18().init, KEY, jnp.zeros((1, 224, 224, 3)))
    convolutions = sum(leaf.size for leaf in jax.tree.leaves(shapes) if leaf.ndim == 4)
    norms = sum(leaf.size for leaf in jax.tree.leaves(shapes) if leaf.ndim == 1)
    # torchvision: 11,689,512 with the classifier of 513,000; 20 norms have 9,600 parameters.
    assert norms == 9_600
    assert convolutions == 11_689_512 - 513_000 - 9_600


def test_resnet18_shrinks_by_32():
    shape = jax.eval_shape(
        lambda x: resnet.ResNet18().init_with_output(KEY, x)[0], jnp.zeros((2, 224, 230, 3))
    ).shape
    assert shape == (2, 7, 8, 512)


def test_the_gradient_of_a_blocks_end_is_jaxs():
    x, y, g = normal(4, 5), normal(5, 4).T, normal(20).reshape(4, 5)
    _, actual = jax.vjp(resnet._relu_of_sum, x, y)
    _, expected = jax.vjp(lambda x, y: jax.nn.relu(x + y), x, y)
    for ours, jaxs in zip(actual(g), expected(g), strict=True):
        np.testing.assert_array_equal(ours, jaxs)


def test_unknown_trunk_is_named():
    with pytest.raises(ValueError, match=r"encoder: expected one of .*small.*got 'vit'"):
        make("vit").init(KEY, frames())


def test_an_image_that_shrinks_to_one_cell_has_no_keypoints():
    with pytest.raises(ValueError, match=r"image: expected more than one cell.*got 32 x 32"):
        jax.eval_shape(make("resnet18").init, KEY, frames(size=32))


@pytest.mark.parametrize("horizon", [1, 2, 4])
def test_state_encoder_sees_all_of_the_history(horizon):
    module = encoders.StateEncoder(16)
    history = normal(3, horizon, 5)
    out, params = jax.jit(module.init_with_output)(KEY, history)
    assert out.shape == (3, 16)
    gradient = jax.jit(jax.grad(lambda h: module.apply(params, h).sum()))(history)
    assert (jnp.abs(gradient).max(-1) > 0).all()


@pytest.mark.parametrize(("stride", "into"), [(1, 32), (2, 16)])
def test_a_block_is_torchvisions_with_groups_of_16_channels(stride, into):
    x = normal(3, 8, 8, into)
    block = resnet.BasicBlock(32, stride)
    params = block.init(KEY, x)["params"]
    norm = GroupNorm(2).init(KEY, normal(3, 8, 8, 32))["params"]

    def conv(name, x, size, stride=1):
        return resnet.Conv2d(32, size, stride).apply({"params": params[name]}, x)

    def group_norm(x):
        return GroupNorm(2).apply({"params": norm}, x)

    y = jax.nn.relu(group_norm(conv("conv1", x, 3, stride)))
    y = group_norm(conv("conv2", y, 3))
    skip = group_norm(conv("downsample_0", x, 1, stride)) if into != 32 else x
    expected = jax.nn.relu(y + skip)
    np.testing.assert_allclose(block.apply({"params": params}, x), expected, atol=1e-5)


def test_variance_at_the_start_is_two_over_fan_out():
    params = resnet.Conv2d(64, 3).init(KEY, normal(1, 4, 4, 32))["params"]
    assert float(params["kernel"].var()) == pytest.approx(2 / (9 * 64), rel=0.03)


def test_the_small_trunks_layers_are_cut_by_relu():
    x, module = frames(), encoders.SmallTrunk()
    variables = jax.jit(module.init)(KEY, x)
    for size, (stride, doubling) in enumerate(
        ((2, 0), (1, 0), (2, 1), (1, 1), (2, 2), (1, 2), (1, 2))
    ):
        params = variables["params"]
        x = resnet.Conv2d(16 << doubling, 3, stride).apply({"params": params[f"Conv2d_{size}"]}, x)
        norm = GroupNorm((16 << doubling) // 8)
        x = jax.nn.relu(norm.apply({"params": params[f"GroupNorm_{size}"]}, x))
    np.testing.assert_allclose(module.apply(variables, frames()), x, atol=1e-4)


def test_a_state_encoder_is_two_convolutions_with_mish_and_one_without():
    history, module = normal(3, 2, 5), encoders.StateEncoder(16)
    params = jax.jit(module.init)(KEY, history)["params"]
    x = history
    for i, (features, size, pad) in enumerate(((4, 3, None), (8, 3, None), (16, 2, 0))):
        x = layers.Conv1d(features, size, padding=pad).apply({"params": params[f"Conv1d_{i}"]}, x)
        x = layers.mish(x) if i < 2 else x
    np.testing.assert_allclose(module.apply({"params": params}, history), x[:, 0], atol=1e-5)


def test_keypoints_and_states_are_float32_where_arithmetic_is_not(monkeypatch):
    seen = []

    def spy(logits, *rest):
        seen.append(logits.dtype)
        return jnp.zeros((len(logits), logits.shape[-1], 2))

    monkeypatch.setattr(spatial_softmax, "spatial_softmax", spy)
    jax.eval_shape(make("small", dtype=jnp.bfloat16).init, KEY, frames())
    assert seen == [jnp.float32]
    state = encoders.StateEncoder(16, dtype=jnp.bfloat16)
    assert jax.eval_shape(state.init_with_output, KEY, normal(3, 2, 5))[0].dtype == jnp.float32
