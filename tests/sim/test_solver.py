"""The contact solver on problems whose answer is known otherwise."""

import pathlib

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import scipy.optimize

from starjax.core.types import Command
from starjax.sim import assets, dynamics, linear, registries, scene, solver
from starjax.sim import env as envs
from starjax.sim.quiet_mjx import mjx

GOLDEN = pathlib.Path(__file__).parents[1] / "golden"
VELOCITIES, LIMITS, CONTACTS = 6, 3, 4
TIMESTEP = 1 / 240
solve = jax.jit(solver.solve, static_argnums=3)
pull = jax.jit(solver.pull)


def random_problem(rng, active=CONTACTS):
    rows = 1 + LIMITS + 3 * CONTACTS
    half = rng.normal(size=(VELOCITIES, VELOCITIES))
    A = 3 * rng.normal(size=(rows, VELOCITIES))
    A[1 + LIMITS + 3 * active :] = 0  # MJX has rows of zeros for contacts that do not touch
    b = A @ rng.normal(size=VELOCITIES) + 0.5 * rng.normal(size=rows) * np.any(A, axis=1)
    arrays = half @ half.T + 0.1 * np.eye(VELOCITIES), 5 * rng.normal(size=VELOCITIES), A, b
    arrays = [jnp.asarray(array, jnp.float32) for array in arrays]
    return solver.Problem(*arrays, jnp.asarray(rng.uniform(0.1, 1.5, CONTACTS), jnp.float32), 1)


def distance_from_cone(u, mu):
    """From `u` `[3]` to the cone u_0 >= mu |u_1, u_2|, by projecting on its nearest ray."""
    sideways = np.hypot(u[1], u[2])
    ray = np.array([mu, 1.0]) / np.hypot(mu, 1.0)
    here = np.array([u[0], sideways])
    if u[0] >= mu * sideways:
        return 0.0
    return np.linalg.norm(here - max(0.0, here @ ray) * ray)


def cost(problem, x):
    M, f, A, b, mu, _ = (np.asarray(part, float) for part in problem)
    r = A @ x - b
    total = 0.5 * x @ M @ x - f @ x + 0.5 * r[0] ** 2
    total += 0.5 * sum(min(limit, 0.0) ** 2 for limit in r[1 : 1 + LIMITS])
    contacts = r[1 + LIMITS :].reshape(-1, 3)
    return total + 0.5 * sum(
        distance_from_cone(u, m) ** 2 for u, m in zip(contacts, mu, strict=True)
    )


@pytest.mark.parametrize("seed", range(8))
def test_the_minimum_is_that_of_a_general_optimiser(seed):
    rng = np.random.default_rng(seed)
    problem = random_problem(rng, active=CONTACTS - seed % 3)
    x, force, error = solve(
        problem, jnp.asarray(rng.normal(size=VELOCITIES), jnp.float32), TIMESTEP
    )
    best = scipy.optimize.minimize(lambda x: cost(problem, x), np.asarray(x, float), tol=1e-14)
    np.testing.assert_allclose(x, best.x, atol=3e-4)
    # At the minimum the forces balance.
    np.testing.assert_allclose(problem.M @ x, problem.f + force, atol=1e-3)
    assert error <= solver.MAX_ERROR_ENERGY


def test_half_the_hessian_is_the_slope_of_the_pull():
    rng = np.random.default_rng(1)
    sliding = 0
    for _ in range(20):
        problem = random_problem(rng)._replace(A=jnp.eye(1 + LIMITS + 3 * CONTACTS))
        r = jnp.asarray(rng.normal(size=problem.b.shape), jnp.float32)
        B = solver.half_hessian(problem, r)
        slope = jax.jacfwd(lambda r, problem=problem: solver.pull(problem, r))(r)
        np.testing.assert_allclose(B.T @ B, slope, atol=2e-5)
        contact = np.asarray(r[-3 * CONTACTS :]).reshape(-1, 3)
        sideways = np.hypot(contact[:, 1], contact[:, 2])
        is_outside = contact[:, 0] < problem.mu * sideways
        sliding += int((is_outside & (problem.mu * contact[:, 0] + sideways > 0)).sum())
    assert sliding > 10  # cones' bends were among them


def test_a_contact_at_rest_on_its_axis_pulls_nothing():
    problem = random_problem(np.random.default_rng(2))
    r = jnp.zeros_like(problem.b)
    np.testing.assert_array_equal(pull(problem, r), 0.0)
    assert jnp.all(jnp.isfinite(solver.half_hessian(problem, r)))


def test_a_solved_problem_stays_as_it_is():
    problem = random_problem(np.random.default_rng(3))
    x, _, _ = solve(problem, jnp.zeros(VELOCITIES), TIMESTEP)
    again, _, _ = solve(problem, x, TIMESTEP)
    np.testing.assert_array_equal(x, again)


def test_what_is_not_finite_ends_and_harms_no_other():
    problem = random_problem(np.random.default_rng(4))
    two = jax.jit(jax.vmap(solver.solve, in_axes=(None, 0, None)))
    starts = jnp.stack([jnp.ones(VELOCITIES), jnp.full(VELOCITIES, jnp.nan)])
    x, _, _ = two(problem, starts, TIMESTEP)
    assert jnp.all(jnp.isnan(x[1]))
    np.testing.assert_array_equal(x[0], two(problem, starts[:1].repeat(2, 0), TIMESTEP)[0][0])


@pytest.mark.parametrize("minimum", [0.03, 0.07, 0.9, 1.0, 1.1, 6.0, 15.0])
def test_the_line_search_finds_a_kink_and_a_bend(minimum):
    def kinked(share):
        return jnp.where(share < minimum, 0.1, 30.0) * (share - minimum)

    def bent(share):
        return (share - minimum) + (share - minimum) ** 3

    for slope in (kinked, bent):
        found = solver.line_search(slope, slope(jnp.zeros(())))
        assert abs(slope(found)) < 0.1 * abs(slope(jnp.zeros(())))


def test_the_line_search_goes_no_further_than_its_last_share():
    assert solver.line_search(lambda share: share - 100.0, jnp.asarray(-100.0)) == 16.0
    assert solver.line_search(lambda share: 0.0 * share, jnp.zeros(())) <= 1.0


def test_small_systems_are_solved_as_by_lapack():
    rng = np.random.default_rng(5)
    for order, stiffness in ((14, 1.0), (14, 1e4), (linear.LOOP_FROM, 1e2)):
        half = rng.normal(size=(order, order)) * np.sqrt(np.geomspace(1.0, stiffness, order))
        H, g = half.T @ half + np.eye(order), rng.normal(size=order)
        x = linear.solve_positive(jnp.asarray(H, jnp.float32), jnp.asarray(g, jnp.float32))
        np.testing.assert_allclose(H @ np.asarray(x, float), g, atol=2e-3)
        np.testing.assert_allclose(x, np.linalg.solve(H, g), atol=2e-3 * np.abs(x).max())


def test_a_solution_that_did_not_converge_says_so(monkeypatch):
    rng = np.random.default_rng(0)
    problem = random_problem(rng)
    monkeypatch.setattr(solver, "MAX_ITERATIONS", 0)
    _, _, error = solver.solve(problem, jnp.zeros(VELOCITIES), TIMESTEP)
    gradient = -problem.f - solver.pull(problem, -problem.b) @ -problem.A
    left = 0.5 * TIMESTEP**2 * np.sum(np.square(gradient) / np.diag(problem.M))
    np.testing.assert_allclose(error, left, rtol=1e-4)
    assert error > 1e3 * solver.MAX_ERROR_ENERGY


@pytest.mark.parametrize(
    ("change", "names"),
    [
        (lambda m: m.geom("arm0/tool/pad_left").__setattr__("condim", 4), "condim"),
        (lambda m: setattr(m.opt, "cone", mujoco.mjtCone.mjCONE_PYRAMIDAL), "PYRAMIDAL"),
        (lambda m: setattr(m.opt, "integrator", mujoco.mjtIntegrator.mjINT_EULER), "EULER"),
        (lambda m: setattr(m.opt, "disableflags", 0), "eulerdamp"),
        (lambda m: m.dof_frictionloss.__setitem__(0, 0.1), "friction loss"),
    ],
)
def test_a_model_that_the_solver_does_not_know_is_refused(change, names):
    m = scene.compose(scene.name())
    change(m)
    with pytest.raises(ValueError, match=f"model: expected.*{names}"):
        solver.check(mjx.put_model(m, impl="jax"), mjx.make_data(m, impl="jax"))


def test_pads_that_close_on_a_needle_need_the_iterations_of_their_scene():
    """The substep of a grasp that ended as `invalid` with the default number."""
    arrays = np.load(GOLDEN / "needle_grasp.npz")
    parts = (jnp.asarray(arrays[name]) for name in ("M", "f", "A", "b", "mu"))
    problem, start = solver.Problem(*parts, equalities=1), jnp.asarray(arrays["x"])
    _, _, error = solve(problem, start, TIMESTEP)
    assert error > dynamics.MAX_SOLVER_ERROR
    iterations = scene._max_solver_iterations(scene.compose(scene.name("needle_pick")))
    x, force, error = solve(problem, start, TIMESTEP, iterations)
    assert error <= solver.MAX_ERROR_ENERGY
    np.testing.assert_allclose(problem.M @ x, problem.f + force, atol=1e-4)


@pytest.fixture(scope="module")
def large(tmp_path_factory):
    """Reach with nine loose balls above a plane: 62 velocities."""
    touches = 'condim="3" contype="1" conaffinity="1"'
    balls = "".join(
        f'<body name="ball{i}" pos="{i / 50 - 0.08} 0.03 0.006"><freejoint/>'
        f'<geom size="0.004" {touches}/></body>'
        for i in range(9)
    )
    balls += f'<geom type="plane" size="1 1 0.1" {touches}/>'
    file = tmp_path_factory.mktemp("large") / "balls.xml"
    reach = f'<include file="{assets.path("tasks/reach/reach.xml")}"/>'
    file.write_text(f"<mujoco>{reach}<worldbody>{balls}</worldbody></mujoco>")
    return registries.tasks.get("reach")._replace(mjcf=str(file))


def test_a_scene_of_many_velocities_has_dense_matrices(large):
    m = scene.compose(scene.name("reach"), large)
    assert m.nv == 62 >= scene.SPARSE_FROM
    solver.check(mjx.put_model(m, impl="jax"), mjx.make_data(m, impl="jax"))
    m.opt.jacobian = mujoco.mjtJacobian.mjJAC_AUTO
    with pytest.raises(ValueError, match=r"model: expected dense.*62 velocities"):
        solver.check(mjx.put_model(m, impl="jax"), mjx.make_data(m, impl="jax"))


@pytest.mark.slow
def test_a_scene_of_many_velocities_runs(large):
    env = envs.make("reach", observation="state", variant=large)
    trocar = jax.tree.map(lambda field: jnp.asarray(field)[0], env.task.trocars)
    state = jax.jit(env.reset)(jax.random.key(0), envs.EnvParams(trocar))
    step = jax.jit(env.step)
    for _ in range(10):
        state = step(state, Command(state.pose, state.gripper))
    assert not state.invalid and state.solver_error < dynamics.max_solver_error(env.scene)
    heights = state.physics.qpos[2:63:7]  # depth of the balls, whose radius is 4 mm
    assert ((heights > 0.003) & (heights < 0.005)).all()


def test_the_limit_on_the_error_is_that_of_every_task_and_grows_beyond_them():
    sizes = [scene.compose(scene.name(name)).nv for name in registries.tasks.built_in]
    assert {solver.size_factor(size) for size in sizes} == {1.0}
    assert solver.size_factor(2 * max(sizes)) == 2.0
