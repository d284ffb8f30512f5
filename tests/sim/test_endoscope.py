"""The endoscope of a task: its region, its view of the work, one pose for an episode."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax import rcm
from starjax.data import schema
from starjax.sim import endoscope_camera, physics, registries, render, scene
from starjax.sim import env as envs
from starjax.sim.rollouts import episodes, programs
from starjax.tasks.needle_handover import task as needle_handover

TASKS = sorted(name for name in registries.tasks.names() if registries.tasks.get(name).endoscope)
CROP = 0.9  # crop of the picture's side


def drawn(scope, count=400):
    keys = jax.random.split(jax.random.key(0), count)
    return jax.vmap(lambda key: endoscope_camera.draw(scope, key))(keys)


def seen(pose, points, scope):
    """Where points `[K, 3]` are in pictures, in halves of a side, `[N, K, 2]`."""
    x = np.einsum("nji,nkj->nki", pose.R, np.asarray(points) - np.asarray(pose.p)[:, None])
    assert (x[..., 2] < 0).all()
    return x[..., :2] / -x[..., 2:] / np.tan(np.deg2rad(scope.fovy) / 2)


def test_the_tasks_with_tools_have_one():
    names = registries.tasks.names()
    tools = {name: registries.tasks.get(name).slots[0].tool for name in names}
    with_jaws = [name for name, tool in tools.items() if not tool.startswith("endoscope")]
    assert sorted(with_jaws) == TASKS


@pytest.mark.parametrize("name", TASKS)
def test_it_stands_in_its_trocar_level_and_near_the_work(name):
    scope = registries.tasks.get(name).endoscope
    pose = drawn(scope)
    work = np.array(scope.work)
    away = np.linalg.norm(pose.p - work, axis=-1)
    spread = np.linalg.norm(scope.spread)
    assert away.min() > 0.06 - spread and away.max() < 0.11 + spread and np.ptp(away) > 0.02
    # Some point of the shaft behind the lens is within the trocar's range.
    back, to_port = np.asarray(pose.R)[..., 2], np.array(scope.p_world_ref) - np.asarray(pose.p)
    along = np.sum(back * to_port, -1, keepdims=True)
    assert (along > 0).all()
    off = np.linalg.norm(to_port - along * back, axis=-1)
    assert off.max() <= scope.radius[1] + 1e-6 and off.max() > 0.5 * scope.radius[1]
    assert np.abs(np.asarray(pose.R)[..., 0] @ np.array(scope.up)).max() < 1e-6  # level
    assert (np.asarray(pose.R)[..., 1] @ np.array(scope.up) > 0).all()
    identity = np.asarray(pose.R) @ np.swapaxes(pose.R, -1, -2)
    np.testing.assert_allclose(identity, np.broadcast_to(np.eye(3), identity.shape), atol=1e-6)


def work_of(name):
    """Points that an episode may be about."""
    bound = registries.tasks.get(name).bind(scene.compose(scene.name(name)))
    if name == "reach":
        return bound.marks
    if name.startswith("peg_transfer"):
        return np.concatenate([bound.pegs, np.full((len(bound.pegs), 1), 0.005)], -1)
    if name == "ring_on_wire":  # the ring where it hangs at either end, and carried at the middle
        return np.array([[0, -0.041, 0.018], [0, 0.041, 0.018], [0, 0, 0.05]])
    if name == "needle_handover":  # a needle of 8 mm at its start and at the pass
        (x, y), aside = needle_handover.PLACE, np.array(needle_handover.PLACE_SPREAD) + 0.008
        corners = [[x + i * aside[0], y + j * aside[1], 0] for i in (-1, 1) for j in (-1, 1)]
        return np.array([*corners, [0, 0, 0.06]])
    x, y = np.meshgrid([-0.035, 0.035], [-0.025, 0.025])  # needle_pick
    return np.stack([x, y, 0 * x], -1).reshape(-1, 3)


@pytest.mark.parametrize("name", TASKS)
def test_the_work_is_in_the_picture(name):
    scope = registries.tasks.get(name).endoscope
    inside = np.abs(seen(drawn(scope), work_of(name), scope)).max(-1) < CROP
    assert inside.mean() > 0.995, inside.mean()
    # A lens at 6 cm, the nearest allowed distance, loses some.
    near = drawn(scope._replace(distance=(0.06, 0.06)))
    assert (np.abs(seen(near, work_of(name), scope)).max(-1) < CROP).mean() < inside.mean()


def test_a_scene_without_it_is_as_ever():
    plain = scene.compose(scene.name("reach"))
    assert plain.ncam + 1 == scene.compose(scene.name("reach", cameras=("endoscope",))).ncam
    assert scene.name("reach", cameras=("fixed",)) == scene.name("reach")
    assert scene.name("endoscope_track", cameras=("fixed",)).cameras == ("camera",)


@pytest.fixture(scope="module")
def environment():
    return envs.make("reach", cameras=("endoscope",), image_size=32)


def test_datasets_and_trajectories_have_its_pose(environment):
    for record in (episodes.DEMONSTRATION, episodes.SCORE):
        frame = programs.frame(environment, record)
        assert frame["endoscope_R"].shape == (3, 3) and frame["endoscope_p"].shape == (3,)
    about = schema.describe(
        environment, rcm.Trocar(*[np.zeros((1, 1))] * 3), schema.DemoSettings(1, 0, 9)
    )
    assert about["scene"]["cameras"] == ("endoscope",)
    assert {"endoscope_R", "endoscope_p", "image_endoscope"} <= about["features"].keys()


@pytest.mark.slow
def test_every_episode_is_seen_from_its_own_place(environment):
    keys = jax.random.split(jax.random.key(5), 2)
    trocars = jax.tree.map(lambda x: jnp.asarray(x)[:2, None], rcm.TROCARS)
    state = jax.jit(jax.vmap(environment.reset))(keys, envs.EnvParams(trocars))
    scope, held = environment.task.endoscope, state.endoscope
    wanted = jax.vmap(lambda key: endoscope_camera.draw(scope, key))(keys)
    np.testing.assert_allclose(held.p, wanted.p, atol=1e-7)
    assert np.linalg.norm(held.p[0] - held.p[1]) > 1e-3
    layout = jax.vmap(lambda key: environment.task.sample(environment.scene.bound, key))(keys)
    np.testing.assert_array_equal(state.layout.p, layout.p)  # as without an endoscope

    m, draw = (
        environment.scene,
        render.make(environment.scene.mj_model, "endoscope", 32, 32, moves=True),
    )

    def look(state):
        data = physics.kinematics(m, state.physics.qpos, state.trocar.p_world_trocar)
        rgb = m.task.colours(m.bound, state.layout, jnp.asarray(m.geom_rgb))
        return environment.observe(state), draw(
            data.geom_xpos, data.geom_xmat, rgb, state.endoscope
        )

    observed, alone = jax.jit(jax.vmap(look))(state)
    np.testing.assert_array_equal(observed.images["endoscope"], alone.rgb)
    np.testing.assert_array_equal(observed.endoscope.p, held.p)
    assert (np.asarray(alone.rgb[0]) != np.asarray(alone.rgb[1])).mean() > 0.1
