"""Maps of arrays are programs, few of which are kept."""

import importlib.util
import inspect

import jax
import numpy as np
import pytest

from starjax import rcm
from starjax.rcm import arrays

DRAWN = np.random.default_rng(0)


def drawn(*shape):
    return DRAWN.normal(size=shape).astype(np.float32)


def test_maps_of_arrays_are_programs_kept_by_shape():
    """A call compiles once for its shapes; a mistake is one line, and tracers are traced."""
    space, trocar = rcm.ACTION_SPACES["rcm3"], jax.tree.map(np.float64, rcm.TROCARS)
    action, where = drawn(12, space.dim), np.float64([0.0, 0.0, 0.15])
    program = inspect.getclosurevars(space.decode.__wrapped__).nonlocals["program"]
    program.clear_cache()
    eager = inspect.unwrap(space.decode)(action, trocar, where)
    for _ in range(3):
        pose, valid = space.decode(action, trocar, where)
    assert program._cache_size() == 1 and valid.all()
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), (pose, valid), eager)
    for given in (float(action[0, 0]), 0.25):  # a number is an argument, not part of the program
        rcm.rotation_z(given)
    assert inspect.getclosurevars(rcm.rotation_z.__wrapped__).nonlocals["program"]._cache_size() < 9
    text = jax.jit(lambda x: space.decode(x, trocar, where)).lower(action).as_text()
    assert program._cache_size() == 1 and "decode_action" not in text
    grad = jax.grad(lambda x: space.decode(x, trocar, where)[0].p.sum())(action)
    assert np.isfinite(grad).all() and program._cache_size() == 1
    with pytest.raises(ValueError) as caught:
        space.decode(action[:, :2], trocar, where)
    assert "\n" not in str(caught.value)


def test_a_program_may_import_the_maps():
    spec = importlib.util.spec_from_file_location("arrays_again", arrays.__file__)
    again = importlib.util.module_from_spec(spec)

    def first_use(x):
        spec.loader.exec_module(again)
        return again.bounded(x)

    jax.jit(first_use)(drawn(3))
    assert again._are_concrete({"x": drawn(3)})
    jax.jit(lambda x: np.testing.assert_(not again._are_concrete({"x": drawn(3)})) or x)(1.0)


def test_few_programs_are_kept(monkeypatch):
    monkeypatch.setattr(arrays, "MAX_PROGRAMS", 3)
    program = inspect.getclosurevars(rcm.rotation_z.__wrapped__).nonlocals["program"]
    for size in range(1, 8):
        rcm.rotation_z(drawn(size))
        assert program._cache_size() <= 3
