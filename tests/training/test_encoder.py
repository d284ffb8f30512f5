"""The encoder of another policy: taken as it is, or refused in one line that says why."""

import dataclasses
import functools

import fakes
import jax
import jax.numpy as jnp
import mistakes
import numpy as np
import pytest
import safetensors.numpy

from starjax.policies import generator, packaged, policy_file
from starjax.policies.models import encoders
from starjax.training import encoder

IMAGE = dataclasses.replace(fakes.TINY, observation="image")


@functools.cache
def initial():
    """Parameters of the encoder of `IMAGE`."""
    vision, size = generator.vision_encoder(IMAGE), IMAGE.image_size
    init = jax.jit(vision.init, compiler_options={"xla_backend_optimization_level": 0})
    return init(jax.random.key(5), jnp.zeros((1, size, size, 3)))


def save(path, method="stardiff", policy_config=IMAGE, change=lambda vision: vision):
    """A file of a policy that is little more than its encoder; returns its parameters."""
    params = {"learner": {"unet": {"kernel": jnp.ones((2, 3))}}}
    if method == "stardiff":
        params["roll"] = {"bias": jnp.ones(3)}
    if policy_config.observation == "image":
        params["vision"] = change(initial())
    policy_file.save(path, fakes.trained(method=method, policy=policy_config, params=params))
    return params


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A policy's file and its parameters."""
    path = tmp_path_factory.mktemp("source") / "policy.safetensors"
    return path, save(path)


def settings(path, **changed):
    return dataclasses.replace(IMAGE, encoder_weights=str(path), **changed)


@pytest.mark.parametrize("method", ["stardiff", "dp_rcm1"])
def test_it_is_found_in_both_kinds_of_policy(tmp_path, method):
    save(tmp_path / "p", method)
    found = encoder.read(settings(tmp_path / "p"))
    jax.tree.map(np.testing.assert_array_equal, found.params, initial())


def test_a_packaged_policy_is_known_by_its_name_or_its_path(source, tmp_path, monkeypatch):
    path, params = source
    monkeypatch.setattr(packaged, "folders", lambda: [tmp_path])
    policy_file.save(tmp_path / "compact.safetensors", policy_file.load(path), half=True)
    named = settings("compact", freeze_encoder=True)
    found = encoder.read(named)
    # The folder of a frozen encoder's features is named by this.
    assert found.fingerprint == encoder.read(settings(tmp_path / "compact.safetensors"))[1]
    assert found.fingerprint != encoder.read(settings(path)).fingerprint
    begun = encoder.start(jax.tree.map(jnp.zeros_like, params), named)
    for leaf, stored in zip(*map(jax.tree.leaves, (begun["vision"], initial()))):
        assert leaf.dtype == jnp.float32
        np.testing.assert_allclose(leaf, stored, rtol=2**-11, atol=3e-8)


def test_fingerprint_tells_weights_apart(source, tmp_path):
    path, _ = source
    other = save(tmp_path / "p", change=lambda v: jax.tree.map(lambda x: x + 1e-3, v))
    one, two = (encoder.read(settings(p)).fingerprint for p in (path, tmp_path / "p"))
    assert one != two and len(one) == len(two)
    again = encoder.read(settings(path, freeze_encoder=True))
    assert again.fingerprint == one != policy_file.fingerprint(other["vision"])


def test_a_policy_that_goes_on_learning_starts_with_it(source):
    path, params = source
    begun = jax.tree.map(jnp.ones_like, params)
    begun["vision"] = jax.tree.map(jnp.zeros_like, params["vision"])
    found = encoder.start(begun, settings(path))
    jax.tree.map(np.testing.assert_array_equal, found["vision"], params["vision"])
    assert all((leaf == 1).all() for leaf in jax.tree.leaves(found["roll"]))


@pytest.mark.parametrize(
    ("ours", "fields"),
    [
        ({"vision_dim": 32}, ["policy.vision_dim 16 (here 32)"]),
        (
            {"encoder": "resnet18", "vision_dim": 32},
            ["policy.encoder small (here resnet18)", "policy.vision_dim 16 (here 32)"],
        ),
        (
            {"freeze_encoder": True, "image_size": 48, "crop_fraction": 0.5},
            ["policy.image_size 32 (here 48)", "policy.crop_fraction 0.9 (here 0.5)"],
        ),
    ],
)
def test_another_architecture_is_a_mistake_that_names_all_that_differs(source, ours, fields):
    path, _ = source
    with mistakes.of("policy.encoder_weights", path) as caught:
        encoder.read(settings(path, **ours))
    assert all(field in caught.value.got for field in fields)


def test_another_picture_is_fine_where_it_goes_on_learning(source):
    path, _ = source
    assert encoder.read(settings(path, image_size=48)) is not None


def test_a_policy_without_a_camera_is_refused(tmp_path):
    save(tmp_path / "p", policy_config=fakes.TINY)
    with mistakes.of("policy.encoder_weights", "policy.observation state (here image)"):
        encoder.read(settings(tmp_path / "p"))


def test_parameters_of_another_network_are_named(tmp_path):
    def change(vision):
        inner = vision["params"]
        return {"params": {**inner, "keypoints": inner["keypoints"][:-1]}}

    save(tmp_path / "p", change=change)
    with mistakes.of("policy.encoder_weights", "(63, 8)") as caught:
        encoder.read(settings(tmp_path / "p"))
    assert "(64, 8)" in caught.value.expected and "keypoints" in caught.value.expected


def test_a_damaged_file_is_one_line(source, tmp_path):
    content = bytearray(source[0].read_bytes())
    content[-5] ^= 1
    (tmp_path / "p").write_bytes(content)
    with mistakes.of("policy.encoder_weights", "damaged"):
        encoder.read(settings(tmp_path / "p"))


def test_a_missing_file_is_one_line():
    with mistakes.of("policy.encoder_weights", "nowhere"):
        encoder.read(settings("nowhere"))


def test_torchvision_fills_a_trunk_only(tmp_path):
    path = tmp_path / "resnet18.safetensors"
    safetensors.numpy.save_file({"conv1.weight": np.zeros((64, 3, 7, 7), np.float32)}, path)
    with mistakes.of("policy.encoder_weights", "conv1.weight"):
        encoder.read(settings(path, encoder="resnet18", image_size=64))
    with mistakes.of("policy.encoder", "small"):
        encoder.read(settings(path))
    with mistakes.of("policy.freeze_encoder", "keypoints untrained"):
        encoder.read(settings(path, encoder="resnet18", freeze_encoder=True))


def test_torchvision_still_starts_a_policy(tmp_path):
    """The trunk's first kernel is the file's, layers that torchvision lacks stay."""
    vision = encoders.ImageEncoder(trunk="resnet18", features=16)
    shapes = jax.eval_shape(vision.init, jax.random.key(0), jnp.zeros((1, 64, 64, 3)))
    begun = {"vision": jax.tree.map(lambda x: jnp.full(x.shape, 0.25), shapes)}
    trunk = begun["vision"]["params"]["trunk"]
    flat = {
        ".".join(entry.key for entry in path[:-1]).replace("_", ".") + ".weight": np.full(
            [leaf.shape[i] for i in (3, 2, 0, 1)], 0.5, np.float32
        )
        for path, leaf in jax.tree_util.tree_leaves_with_path(trunk)
        if path[-1].key == "kernel"
    }
    path = tmp_path / "resnet18.safetensors"
    safetensors.numpy.save_file(flat, path)
    ours = settings(path, encoder="resnet18", image_size=64)
    assert encoder.read(ours) is None
    found = encoder.start(begun, ours)["vision"]["params"]
    assert (found["trunk"]["conv1"]["kernel"] == 0.5).all()
    assert (found["keypoints"] == 0.25).all()
