"""Every public map works, with the same values and derivatives, under every strict mode of jax."""

import functools
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from strict import STRICT, mode

from starjax import rcm

N = 5
DRAWN = np.random.default_rng(0)


def drawn(*shape):
    """Numbers that bfloat16 has, and some that are whole."""
    return np.round(DRAWN.normal(size=shape, scale=2.0) * 4) / 4


ROTATION = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
ROTATIONS = np.broadcast_to(ROTATION, (N, 3, 3))
POSE = rcm.Pose(ROTATIONS, drawn(3))
TROCAR = rcm.Trocar(np.full((2, N), 2.0), np.ones(N), np.array(3.0))
POINT = drawn(3)
WRIST = rcm.Wrist(0.25, 0.5, 1.0, 1.0)
# Axes in every direction, of which bfloat16 has the entries; their lines meet.
AXES = np.array(
    [[0.0, 0.5, -1.0], [0.5, 0.25, -1.0], [-0.5, 0.0, -1.0], [0.25, -0.5, -1.0], [1, 1, 1]]
)
MOVING = rcm.Pose(ROTATION + AXES[..., None] * np.array([0.0, 0.0, 1.0]), POINT / 32 + AXES / 64)
# Arguments of each public function; every number of axes and type that jax may refuse to mix.
GIVEN = {
    "check_trocar": (TROCAR,),
    "insertion_depth": (POSE, POINT),
    "pose_at_depth": (ROTATIONS, drawn(2, N), POINT),
    "pose_on_manifold": (drawn(N, 3), drawn(2, N), 2.0, POINT),
    "project": (POSE, drawn(2, N, 3)),
    "rcm_error": (POSE, drawn(2, N, 3)),
    "roll_of": (ROTATION,),
    "rot6d_decode": (drawn(N, 6),),
    "rot6d_encode": (ROTATION,),
    "rotation_align": (drawn(2, N, 3), POINT),
    "rotation_from_axis_roll": (drawn(N, 3), drawn(2, N)),
    "rotation_z": (drawn(N),),
    "trocar_frame": (TROCAR, POINT),
    "trocar_from_poses": (MOVING,),
    "trocar_from_position": (drawn(N, 3), POINT),
    "trocar_position": (TROCAR, POINT),
    "trocar_rotation": (TROCAR,),
}
STRAIGHT = [space for space in rcm.ACTION_SPACES.values() if space.for_wrist is None]
SPACES = [*STRAIGHT, rcm.rcm6(WRIST)]
WRISTED = {
    "angles_through": (POSE, drawn(2, N, 3)),
    "shaft_of": (POSE, drawn(2, N, 2)),
    "through": (POSE, drawn(2, N, 3)),
    "tip_of": (POSE, drawn(2, N, 2)),
}
FUNCTIONS = {name: (getattr(rcm, name), given) for name, given in GIVEN.items()}
FUNCTIONS |= {
    name: (functools.partial(getattr(rcm, name), WRIST), given) for name, given in WRISTED.items()
}
FUNCTIONS |= {f"{s.name}.decode": (s.decode, (drawn(N, s.dim), TROCAR, POINT)) for s in SPACES}
FUNCTIONS |= {f"{s.name}.encode": (s.encode, (POSE, TROCAR, POINT)) for s in SPACES}
TYPES = (jnp.bfloat16, jnp.int32)  # by turns


def as_type(given, dtype):
    """The first argument in this type, the others in float32."""
    first, *others = jax.tree.map(lambda x: np.asarray(x, np.float32), given)
    return (jax.tree.map(lambda x: x.astype(dtype), first), *others)


# They make action spaces, and take no arrays.
SPACES = ("action_space", "rcm6", "se3_through", "se3_wrist")


def test_all_public_functions_are_here():
    public = {name for name in rcm.__all__ if callable(getattr(rcm, name))}
    assert public - {"ActionSpace", "Pose", "Trocar", "TrocarEstimate", "TrocarFrame"} - {
        "Wrist",
        "WristPose",
    } == {*GIVEN, *WRISTED, *SPACES, "sample_trocar", "why_undetermined"}


def assert_same_program(name, arrays, strict, wanted):
    """Asserts that a strict mode has the values of jax's own settings."""
    # Error checks add their tests to a program; without them it is the same.
    unchecked = {k: v for k, v in strict.items() if "error_checking" not in k}
    function = FUNCTIONS[name][0]
    with mode(strict):
        placed = jax.device_put(arrays)
        assert jax.eval_shape(function, *placed) == wanted.out_info
        if name == "check_trocar":  # it looks at values
            function(*placed)
    with mode(unchecked):
        assert lowered(function, placed).as_text() == wanted.as_text()


def lowered(function, arrays):
    def program(*arrays):
        return function(*arrays)

    return jax.jit(program).lower(*arrays)


@pytest.mark.parametrize(("i", "name"), list(enumerate(FUNCTIONS)))
@pytest.mark.filterwarnings("error")
def test_values_are_those_of_jaxs_own_settings(i, name):
    """Other types are read as float32, before anything else."""
    function, given = FUNCTIONS[name]
    arguments = as_type(given, TYPES[i % 2])

    def converted(*arrays):
        return function(*jax.tree.map(jnp.float32, arrays))

    kind = function if name == "check_trocar" else converted  # it returns its argument
    assert_same_program(name, arguments, STRICT, lowered(kind, arguments))


@pytest.mark.parametrize("name", [name for name in FUNCTIONS if name != "check_trocar"])
def test_derivatives_take_arrays_of_any_number_of_axes(name):
    function, given = FUNCTIONS[name]
    arguments = jax.tree.map(np.float32, given)

    def slope(*arrays):
        floats = (x for x in jax.tree.leaves(function(*arrays)) if x.dtype == jnp.float32)
        return sum(jnp.sum(x) for x in floats)

    gradient = jax.grad(slope, tuple(range(len(given))))
    wanted = lowered(gradient, arguments).as_text()
    with jax.numpy_rank_promotion("raise"):
        assert lowered(gradient, arguments).as_text() == wanted


@pytest.mark.release
@pytest.mark.filterwarnings("error")
def test_a_program_in_double_precision_has_the_same_values():
    usual, double = {}, {}
    for name, (function, arrays) in FUNCTIONS.items():
        usual[name] = jax.tree.map(np.float32, arrays)
        double[name] = (arrays[0], *usual[name][1:])
        with jax.enable_x64(True):
            wanted = lowered(function, double[name])
        assert_same_program(name, double[name], {**STRICT, "jax_enable_x64": True}, wanted)
    wanted = values(usual)
    with jax.enable_x64(True):
        found = values(double)
    for name in FUNCTIONS:
        jax.tree.map(
            lambda a, b, name=name: np.testing.assert_allclose(a, b, atol=2e-6, err_msg=name),
            found[name],
            wanted[name],
        )


@jax.jit
def values(given):
    """What every function says, in one program."""
    return {name: FUNCTIONS[name][0](*arrays) for name, arrays in given.items()}


def test_a_program_that_looks_for_nan_finds_none_where_inputs_are_finite():
    """In a process of its own: jax looks at nothing that ran before under its usual settings."""
    path = os.pathsep.join(sys.path)
    subprocess.run([sys.executable, __file__], env={**os.environ, "PYTHONPATH": path}, check=True)


def look_for_nan():
    """These return NaN for inputs that are not finite; without jit each operation is looked at."""
    for name in ("angles_through", "project", "roll_of", "through", "trocar_from_position"):
        function, given = FUNCTIONS[name]
        with mode({"jax_debug_nans": True, "jax_disable_jit": True}):
            function(*given)
            first, *others = jax.tree.map(lambda x: np.where(x == x.max(), np.nan, x), given)
            with pytest.raises(FloatingPointError):
                function(first, *others)


def test_draws_are_those_of_jaxs_own_settings():
    wanted = jax.device_get(rcm.sample_trocar(jax.random.key(0), (N,)))
    with jax.transfer_guard("allow"):
        key = jax.random.key(0)
    with mode(STRICT):
        found = jax.device_get(rcm.sample_trocar(key, (N,)))
    jax.tree.map(np.testing.assert_array_equal, found, wanted)


if __name__ == "__main__":
    look_for_nan()
