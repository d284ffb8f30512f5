"""ImageNet weights for the ResNet-18: every convolution, under any prefix of a file."""

import pickle

import jax
import jax.numpy as jnp
import mistakes
import ml_dtypes
import numpy as np
import pytest
import safetensors.numpy

from starjax.policies.models import pretrained, resnet


@pytest.fixture(scope="module")
def trunk():
    """Parameters of a narrow ResNet-18."""
    shapes = jax.eval_shape(
        resnet.ResNet18(width=16).init, jax.random.key(0), jnp.zeros((1, 64, 64, 3))
    )
    return jax.tree.map(lambda x: jnp.full(x.shape, 0.25, x.dtype), shapes)["params"]


@pytest.fixture(scope="module")
def weights():
    """A torchvision state dictionary of that width, with its norms and classifier."""
    rng = np.random.default_rng(1)
    shapes = {"conv1.weight": (16, 3, 7, 7), "bn1.weight": (16,), "fc.weight": (10, 128)}
    for stage in range(4):
        width = 16 << stage
        for block in range(2):
            name, into = f"layer{stage + 1}.{block}", width // 2 if stage and not block else width
            shapes[f"{name}.conv1.weight"] = (width, into, 3, 3)
            shapes[f"{name}.conv2.weight"] = (width, width, 3, 3)
            shapes[f"{name}.bn2.running_var"] = (width,)
            if stage and not block:
                shapes[f"{name}.downsample.0.weight"] = (width, into, 1, 1)
    return {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}


def save(path, weights):
    path = path / "resnet18.safetensors"
    safetensors.numpy.save_file(weights, path)
    return path


def under(weights, *prefixes):
    return {prefix + name: weight for prefix in prefixes for name, weight in weights.items()}


def assert_filled(filled, trunk, weights, rounding=0.0):
    """Every convolution is the file's, all else as it was."""
    assert jax.tree.structure(filled) == jax.tree.structure(trunk)
    for path, leaf in jax.tree_util.tree_leaves_with_path(filled):
        names = [entry.key for entry in path]
        assert leaf.dtype == jnp.float32
        if names[-1] == "kernel":
            name = ".".join(names[:-1]).replace("_", ".") + ".weight"
            wanted = np.einsum("oihw->hwio", weights[name])
            np.testing.assert_allclose(leaf, wanted, rtol=rounding, atol=1e-6 * bool(rounding))
        else:
            np.testing.assert_array_equal(leaf, 0.25)


@pytest.mark.parametrize(
    "prefix",
    [
        "",
        "module.",
        "state_dict.",
        "model.",
        "encoder.",
        "backbone.",
        "state_dict.module.backbone.",
        "module.convnet.",  # R3M
        "_orig_mod.",  # torch.compile
    ],
)
def test_every_convolution_is_filled_under_any_prefix(trunk, weights, tmp_path, prefix):
    path = save(tmp_path, under(weights, prefix) | {"epoch": np.zeros(1)})
    assert_filled(pretrained.load_resnet18(trunk, path), trunk, weights)


@pytest.mark.parametrize(
    ("copy", "encoder"),
    [
        ("module.encoder_k.", "module.encoder_q."),  # MoCo
        ("module.momentum_encoder.", "module.base_encoder."),  # MoCo v3
        ("student.backbone.", "teacher.backbone."),  # DINO
    ],
)
def test_a_copy_beside_the_encoder_is_passed_over(trunk, weights, tmp_path, copy, encoder):
    other = {name: weight + 1 for name, weight in weights.items()}
    path = save(tmp_path, under(other, copy) | under(weights, encoder))
    assert_filled(pretrained.load_resnet18(trunk, path), trunk, weights)


@pytest.mark.parametrize(("dtype", "rounding"), [(np.float16, 1e-3), (ml_dtypes.bfloat16, 1e-2)])
def test_narrow_weights_become_float32(trunk, weights, tmp_path, dtype, rounding):
    path = save(tmp_path, {name: weight.astype(dtype) for name, weight in weights.items()})
    assert_filled(pretrained.load_resnet18(trunk, path), trunk, weights, rounding)


def test_a_filled_convolution_is_torchs_cross_correlation(trunk, weights, tmp_path):
    """The stem's response to a single bright pixel is its kernel, mirrored."""
    filled = pretrained.load_resnet18(trunk, save(tmp_path, weights))
    image = jnp.zeros((1, 16, 16, 3)).at[0, 8, 6, 1].set(1.0)
    out = resnet.Conv2d(16, 7, 2).apply({"params": filled["conv1"]}, image)
    kernel = weights["conv1.weight"]
    for row, column in ((4, 2), (3, 3), (5, 4)):
        tap = kernel[:, 1, 8 - (2 * row - 3), 6 - (2 * column - 3)]
        np.testing.assert_allclose(out[0, row, column], tap, rtol=1e-6)


def test_other_weights_are_refused_by_what_is_there(trunk, weights, tmp_path):
    name = "layer3.0.downsample.0.weight"
    cases = {
        "bn1.weight": {n: w for n, w in weights.items() if n != name},
        "(64, 32, 3, 3)": {**weights, name: np.zeros((64, 32, 3, 3), np.float32)},
        "others": {**weights, name: weights[name] * np.nan},
        "several: a., b.": under(weights, "a.", "b."),
        "layer1.2.conv1.weight": weights | {"layer1.2.conv1.weight": weights["bn1.weight"]},
        "b, c, d, e and 2 more": {n: np.zeros(1) for n in "bcdefg"},
    }
    for got, changed in cases.items():
        path = save(tmp_path, changed)
        with mistakes.of(str(path), got):
            pretrained.load_resnet18(trunk, path)


@pytest.mark.parametrize("ending", ["pth.tar", "bin", "PTH", "th", "safetensors"])
@pytest.mark.parametrize("start", [b"PK\x03\x04", pickle.dumps({})[:2]])
def test_a_pickle_is_refused_unread_with_the_way_to_convert_it(tmp_path, ending, start):
    path = tmp_path / f"resnet18.{ending}"
    path.write_bytes(start + 64 * b"not read")
    with mistakes.of(str(path), path.name) as caught:
        pretrained.read_weights(path)
    assert "save_file" in caught.value.hint


def test_a_file_of_no_known_kind_is_refused(tmp_path):
    for name, content in (("w.onnx", b""), ("w.safetensors", b"\xff" * 64)):
        (tmp_path / name).write_bytes(content)
        with mistakes.of(str(tmp_path / name), name):
            pretrained.read_weights(tmp_path / name)
    with mistakes.of(str(tmp_path / "none"), "none"):
        pretrained.read_weights(tmp_path / "none")
