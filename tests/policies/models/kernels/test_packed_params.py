"""Packed parameters, unpacked, are unchanged."""

import chex
import jax
import numpy as np

from starjax.core.config import TrainConfig
from starjax.policies.models import encoders, kernels
from starjax.policies.models.kernels import packed_params
from starjax.training.state import make_optimizer


def params():
    names = ("late", "early", "scalar", "kernel")
    shapes = ((3,), (2,), (), (2, 4))
    arrays = [np.random.default_rng(i).random(s, np.float32) for i, s in enumerate(shapes)]
    return {"net": dict(zip(names, arrays, strict=True))}


def test_what_is_packed_can_be_unpacked():
    given = params()
    found = packed_params.pack(given, given)
    assert found.vectors.shape == (6,)
    assert jax.tree.leaves(found.matrices)[0].shape == (2, 4)
    chex.assert_trees_all_equal(kernels.unpacked(found), given)


def test_a_matrix_that_is_held_flat_is_no_vector():
    given = params()
    flat = {"net": {**given["net"], "kernel": given["net"]["kernel"].ravel()}}
    found = packed_params.pack(flat, given)
    assert found.vectors.shape == (6,)
    chex.assert_trees_all_equal(kernels.unpacked(found), flat)


def test_kernels_of_convolutions_are_turned():
    kernel = np.random.default_rng(0).random((3, 2, 4, 5), np.float32)
    given = {"bias": np.zeros(5, np.float32), "kernel": kernel}
    found = packed_params.pack(given, given)
    np.testing.assert_array_equal(found.matrices["kernel"][1], kernel[..., 1])
    chex.assert_trees_all_equal(kernels.unpacked(found), given)


def test_all_that_holds_parameters_is_packed():
    given = params()
    held = {"params": given, "opt_state": make_optimizer(TrainConfig()).init(given), "step": 3}
    found = packed_params.pack(held, given)
    vectors = [x for x in jax.tree.leaves(found) if np.shape(x) == (6,)]
    assert len(vectors) == 3  # parameters and both moments
    assert len(jax.tree.leaves(found)) == len(jax.tree.leaves(held)) - 3 * 2
    chex.assert_trees_all_equal(kernels.unpacked(found), held)


def test_without_vectors_nothing_is_lost():
    given = {"kernel": np.ones((2, 2), np.float32)}
    chex.assert_trees_all_equal(kernels.unpacked(packed_params.pack(given, given)), given)


def test_a_network_takes_packed_parameters_as_it_takes_others():
    network = encoders.SmallTrunk(width=16)
    image = jax.random.normal(jax.random.key(0), (2, 16, 16, 3))
    params = network.init(jax.random.key(1), image)
    packed = packed_params.pack(params, params)
    assert len(jax.tree.leaves(packed)) == len(jax.tree.leaves(params)) - 2 * 7 + 1
    apply = jax.jit(kernels.applied(network))
    chex.assert_trees_all_equal(apply(packed, image), apply(params, image))
