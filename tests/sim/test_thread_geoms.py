"""Links of a thread in images: the camera's and the page's geoms follow its points."""

from types import SimpleNamespace

import jax.numpy as jnp
import mujoco
import numpy as np

from starjax.sim import render, thread_geoms
from starjax.sim.state import EnvState

COUNT, LINK, RADIUS = 32, 0.005, 0.0008  # points; m
LINKS = "".join(
    f'<geom name="thread{i}" type="capsule" size="{RADIUS} {LINK / 2}" '
    f'rgba="0 0 1 1" mass="0" contype="0" conaffinity="0"/>'
    for i in range(COUNT - 1)
)
MODEL = mujoco.MjModel.from_xml_string(
    f"""<mujoco><worldbody><geom name="pad" type="plane" size="1 1 1" rgba="1 1 1 1"/>
    <camera name="camera" pos="0 0 0.3" fovy="40"/>{LINKS}
    <body><joint type="slide"/><geom size="0.001" rgba="0 0 0 0"/></body></worldbody></mujoco>"""
)
TURN = np.cumsum(np.linspace(-0.2, 0.3, COUNT - 1))  # rad, a thread that lies in a bend
STEPS = LINK * np.stack([np.cos(TURN), np.sin(TURN), np.zeros(COUNT - 1)], -1)
POINTS = np.array([-0.05, 0.0, 0.02]) + np.concatenate([np.zeros((1, 3)), np.cumsum(STEPS, 0)])
COORDINATES = np.append(np.zeros(1, np.float32), POINTS)


def test_links_join_the_points():
    data = mujoco.MjData(MODEL)
    mujoco.mj_kinematics(MODEL, data)
    qpos, points = thread_geoms.split(MODEL, COORDINATES)
    assert qpos.shape == (1,)
    thread_geoms.place(MODEL, data, points)
    rows = thread_geoms.ids(MODEL)
    assert len(rows) == COUNT - 1
    half = 0.5 * LINK * data.geom_xmat[rows].reshape(-1, 3, 3)[..., 2]
    np.testing.assert_allclose(data.geom_xpos[rows] - half, POINTS[:-1], atol=1e-6)
    np.testing.assert_allclose(data.geom_xpos[rows] + half, POINTS[1:], atol=1e-6)
    R = data.geom_xmat[rows].reshape(-1, 3, 3)
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (31, 1, 1)), atol=1e-5)


def test_coordinates_of_a_batch_are_those_of_its_states():
    qpos = jnp.arange(12.0).reshape(3, 4)
    points = jnp.arange(90.0).reshape(3, 10, 3)

    def coordinates(qpos, points):
        state = SimpleNamespace(physics=SimpleNamespace(qpos=qpos), thread=points)
        return EnvState.coordinates.fget(state)

    rows = [coordinates(*row) for row in zip(qpos, points, strict=True)]
    np.testing.assert_array_equal(coordinates(qpos, points), rows)


def test_camera_draws_the_thread_where_it_is():
    blank = SimpleNamespace(
        geom_xpos=jnp.zeros((MODEL.ngeom, 3)), geom_xmat=jnp.tile(jnp.eye(3), (MODEL.ngeom, 1, 1))
    )
    blank.replace = lambda **fields: SimpleNamespace(**{**blank.__dict__, **fields})
    data = thread_geoms.placed(MODEL, blank, jnp.asarray(POINTS))
    draw = render.make(MODEL, "camera", 96, 96, shadow=False)
    rgb = np.asarray(draw(data.geom_xpos, data.geom_xmat, render.geom_rgb(MODEL)).rgb, int)
    blue = np.argwhere(rgb[..., 2] > rgb[..., 0] + 40)
    # Pixels of a camera above, that looks down with y up.
    scale = 48 / np.tan(np.radians(20.0)) / (0.3 - POINTS[:, 2])
    at = np.stack([48 - scale * POINTS[:, 1], 48 + scale * POINTS[:, 0]], -1)
    at = at[np.all((at > 2) & (at < 94), -1)]
    off = np.linalg.norm(blue[:, None] + 0.5 - at[None], axis=-1)
    assert len(blue) > 30
    assert off.min(1).max() < 2.5 and off.min(0).max() < 2.0


def test_models_without_a_thread_keep_their_coordinates():
    plain = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><geom size='1'/></worldbody></mujoco>"
    )
    coordinates = np.zeros(0)
    qpos, points = thread_geoms.split(plain, coordinates)
    assert qpos is coordinates and points.shape == (0, 3)
    assert thread_geoms.placed(plain, None, points) is None
