"""Every public map broadcasts as documented, under any rank promotion of jax."""

import functools
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax import rcm
from starjax.rcm import arrays

N = 5
DRAWN = np.random.default_rng(0)


def drawn(*shape):
    return DRAWN.normal(size=shape).astype(np.float32)


ROTATION = np.asarray(rcm.rot6d_decode(drawn(N, 6)))
POSE = rcm.Pose(R=ROTATION, p=drawn(3))
TROCAR = rcm.Trocar(np.full((2, N), 0.02, np.float32), np.full(N, 1.5, np.float32), 0.3)
POINT = drawn(3)
# Arguments whose numbers of axes differ wherever a function takes several.
MIXED = {
    "check_trocar": (TROCAR,),
    "insertion_depth": (POSE, POINT),
    "pose_at_depth": (ROTATION, drawn(2, N), POINT),
    "pose_on_manifold": (drawn(N, 3), drawn(2, N), 0.1, POINT),
    "project": (POSE, drawn(2, N, 3)),
    "rcm_error": (POSE, drawn(2, N, 3)),
    "roll_of": (ROTATION,),
    "rot6d_decode": (drawn(N, 6),),
    "rot6d_encode": (ROTATION,),
    "rotation_align": (drawn(2, N, 3), POINT),
    "rotation_from_axis_roll": (drawn(N, 3), drawn(2, N)),
    "rotation_z": (drawn(N),),
    "sample_trocar": (jax.random.key(0), (N,)),
    "trocar_frame": (TROCAR, POINT),
    "trocar_from_poses": (rcm.Pose(R=ROTATION, p=drawn(N, 3)),),
    "trocar_from_position": (drawn(N, 3), POINT),
    "trocar_position": (TROCAR, POINT),
    "trocar_rotation": (TROCAR,),
}
WRISTED = {
    "angles_through": (POSE, drawn(2, N, 3)),
    "shaft_of": (POSE, drawn(2, N, 2)),
    "through": (POSE, drawn(2, N, 3)),
    "tip_of": (POSE, drawn(2, N, 2)),
}


def test_no_public_function_is_left_out():
    public = {name for name in rcm.__all__ if inspect.isfunction(getattr(rcm, name))}
    spaces = {"rcm6", "se3_through", "se3_wrist"}
    assert public == {*MIXED, *WRISTED, *spaces, "why_undetermined"}


@pytest.mark.parametrize("name", MIXED)
def test_ranks_may_differ_where_jax_forbids_it(name):
    alike(getattr(rcm, name), MIXED[name])


@pytest.mark.parametrize("name", WRISTED)
def test_ranks_of_a_wrist_may_differ_where_jax_forbids_it(name):
    function = functools.partial(getattr(rcm, name), rcm.LARGE_NEEDLE_DRIVER)
    alike(function, WRISTED[name])


STRAIGHT = [space for space in rcm.ACTION_SPACES.values() if space.for_wrist is None]
SPACES = [*STRAIGHT, rcm.rcm6(rcm.LARGE_NEEDLE_DRIVER)]


@pytest.mark.parametrize("space", SPACES, ids=[space.name for space in SPACES])
def test_ranks_of_an_action_may_differ_where_jax_forbids_it(space):
    alike(space.decode, (drawn(N, space.dim), TROCAR, POINT))
    alike(space.encode, (POSE, TROCAR, POINT))


def alike(function, arguments):
    """Asserts that values and derivatives are computed as under jax's own setting."""
    if function in (rcm.check_trocar, rcm.sample_trocar):  # these look at values
        wanted = function(*arguments)
        with jax.numpy_rank_promotion("raise"):
            got = function(*arguments)
        jax.tree.map(np.testing.assert_array_equal, got, wanted)
        return

    def slope(*arrays):
        floats = (x for x in jax.tree.leaves(function(*arrays)) if x.dtype == jnp.float32)
        return sum(jnp.sum(x) for x in floats)

    for kind in (function, jax.grad(slope, tuple(range(len(arguments))))):
        wanted = program(kind, arguments)
        with jax.numpy_rank_promotion("raise"):
            assert program(kind, arguments) == wanted


def program(function, arguments):
    """What jax would compile; the values of a program are the same wherever it is the same."""
    return jax.jit(function).lower(*arguments).as_text()


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


def test_few_programs_are_kept(monkeypatch):
    monkeypatch.setattr(arrays, "MAX_PROGRAMS", 3)
    program = inspect.getclosurevars(rcm.rotation_z.__wrapped__).nonlocals["program"]
    for size in range(1, 8):
        rcm.rotation_z(drawn(size))
        assert program._cache_size() <= 3
