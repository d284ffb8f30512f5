"""The hash maps numbers one to one, mixes all bits, and is the same in numpy and in jax."""

import jax.numpy as jnp
import numpy as np

from starjax.runtime import hashing


def test_one_bit_of_the_number_flips_each_bit_of_the_hash_half_of_the_time():
    x = np.random.default_rng(0).integers(0, 2**32, 20_000, np.uint32)
    for bit in range(32):
        changed = hashing.lowbias32(x) ^ hashing.lowbias32(x ^ np.uint32(1 << bit))
        flips = [np.mean((changed >> other) & 1) for other in range(32)]
        np.testing.assert_allclose(flips, 0.5, atol=0.02)


def test_no_two_numbers_share_a_hash():
    x = np.arange(1 << 20, dtype=np.uint32)
    assert len(np.unique(hashing.lowbias32(x))) == len(x)


def test_jax_and_numpy_agree():
    x = np.arange(1000, dtype=np.uint32) * np.uint32(4_000_037)
    np.testing.assert_array_equal(hashing.lowbias32(jnp.asarray(x)), hashing.lowbias32(x))
