"""Programs that are compiled before they are called."""

import jax
import jax.numpy as jnp
import pytest

from starjax.runtime import precompile

ROW = jax.ShapeDtypeStruct((3,), jnp.float32)


def test_prepared_arguments_meet_their_executable_and_others_the_function():
    traces = []
    program = precompile.Program(lambda x: traces.append(x.shape) or 2.0 * x)
    assert precompile.start(lambda: program.prepare(ROW).shape)() == (3,)
    assert program(jnp.ones(3)).tolist() == [2.0] * 3
    assert traces == [(3,)]
    assert program(jnp.ones(2)).tolist() == [2.0] * 2
    assert traces == [(3,), (2,)]
    assert program.is_prepared(jnp.ones(3)) and not program.is_prepared(jnp.ones(3, jnp.int32))


def test_an_error_is_raised_where_the_program_is_called():
    def function(x):
        raise ValueError(x.shape)

    program = precompile.Program(function)
    assert precompile.start(lambda: program.prepare(ROW))() is None
    with pytest.raises(ValueError, match="3"):
        program(jnp.ones(3))
