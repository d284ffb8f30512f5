"""Loops of the simulation end: their conditions hold no floating-point arithmetic."""

import jax
import jax.numpy as jnp
import loops
import numpy as np
import pytest

from starjax.sim import iteration


@pytest.mark.parametrize("most", [0, 1, 3, 50])
def test_halves_each_lane_until_it_is_small_or_the_iterations_end(most):
    start = jnp.array([0.3, 5.0, 1e6])
    halved = jax.vmap(
        lambda x: iteration.improve_while(lambda x: x > 1.0, lambda x: 0.5 * x, x, most)
    )(start)
    counts = np.minimum(np.maximum(np.ceil(np.log2(start)), 0), most)
    np.testing.assert_allclose(halved, start * 0.5**counts, rtol=1e-6)


def test_no_loop_of_the_solver_has_a_condition_of_floats():
    found = loops.conditions("peg_transfer")
    assert found and not any(map(loops.with_floats, found))
