"""Depth and a second lens by a camera's name."""

import jax
import jax.numpy as jnp
import mistakes
import mujoco
import numpy as np
import pytest

from starjax.core.types import Pose
from starjax.data import augment
from starjax.evaluation.disturbances import DISTURBANCES, base
from starjax.policies import features
from starjax.sim import derived_views, env, render, scene
from starjax.sim.camera import tissue
from starjax.sim.state import EnvParams

SIZE = 32
VIEWS = ("camera", "camera_right", "camera_depth", "endoscope_tissue")


def test_names_of_views():
    known = ["camera", "side", "cam_right"]
    assert derived_views.parse("camera", known) == ("camera", 0.0, False, "")
    assert derived_views.parse("camera_depth", known) == ("camera", 0.0, True, "")
    right = derived_views.parse("side_right_depth", known)
    assert right[:3] == ("side", derived_views.BASELINE, True)
    assert derived_views.parse("cam_right", known)[:3] == ("cam_right", 0.0, False)  # its own
    lit = derived_views.parse("side_right_tissue", known)
    assert lit == ("side", derived_views.BASELINE, False, tissue.NAME)
    for name in derived_views.names(known):
        assert derived_views.parse(name, known).camera in known
    with mistakes.of("camera", "camera_left"):
        scene.name("reach", cameras=["camera_left"])
    assert scene.name("reach", cameras=["endoscope_tissue"]).cameras == ("endoscope_tissue",)
    with mistakes.of("camera", "endoscope_depth"):  # it is elsewhere in every episode
        scene.name("reach", cameras=["endoscope_depth"])


def test_a_depth_image_holds_the_depth_to_a_tenth_of_a_millimetre():
    depth = np.linspace(derived_views.NEAR, derived_views.FAR, 40_000, dtype=np.float32)
    image = derived_views.encode(jnp.asarray(depth.reshape(200, 200)))
    assert image.dtype == jnp.uint8
    found = derived_views.decode(np.asarray(image)).ravel()
    assert np.abs(found - depth).max() < 1e-4
    jump = np.abs(np.diff(np.asarray(image, int).reshape(-1, 3), axis=0))
    assert jump.max() <= 1  # the waves have no jumps
    beyond = derived_views.encode(jnp.array([[0.0, 2.0**20]]))
    np.testing.assert_allclose(
        derived_views.decode(np.asarray(beyond)), [[derived_views.NEAR, derived_views.FAR]]
    )


def test_depth_is_neither_jittered_nor_disturbed():
    rng = np.random.default_rng(0)
    images = rng.integers(60, 200, (1, 2, 2, SIZE, SIZE, 3), np.uint8)  # two steps, two cameras
    sensors = features.Sensors(None, ("camera", "camera_depth"))
    strength = features._of_colours(0.5, sensors.cameras)
    changed, _ = augment.augment(
        jax.random.key(0), jnp.asarray(images), crop=SIZE, jitter=strength, noise=strength
    )
    plain = augment.center(jnp.asarray(images), crop=SIZE)
    np.testing.assert_allclose(changed[:, :, 1], plain[:, :, 1], atol=1e-6)
    assert np.abs(changed[:, :, 0] - plain[:, :, 0]).max() > 0.1
    assert features._of_colours(0.5, ("camera", "camera_right")) == 0.5

    dark, image = DISTURBANCES.get("darkness"), jnp.asarray(images[0, 0, 0])
    state = base.start("darkness", 0.4, jax.random.key(0))
    step = jnp.zeros((), jnp.int32)
    np.testing.assert_array_equal(base.change_image(dark, state, image, step, "x_depth"), image)
    assert (base.change_image(dark, state, image, step, "x_right") != image).any()


@pytest.mark.slow
def test_views_of_a_scene_are_those_of_the_camera_and_of_one_beside_it():
    made = env.make("reach", image_size=SIZE, cameras=VIEWS)
    trocar = jax.tree.map(lambda field: field[0], made.task.trocars)
    state = jax.jit(made.reset)(jax.random.key(0), EnvParams(trocar))
    images = jax.jit(made.observe)(state).images
    assert {name: image.shape for name, image in images.items()} == dict.fromkeys(
        VIEWS, (SIZE, SIZE, 3)
    )
    assert np.any(images["camera"] != images["camera_right"])
    red, green, _ = images["endoscope_tissue"].reshape(-1, 3).mean(0)
    assert red > 1.3 * green and state.endoscope is not None

    m = made.scene.mj_model
    depth = derived_views.decode(np.asarray(images["camera_depth"]))
    cloud = derived_views.points(depth, m, "camera_depth")
    inside = (depth > derived_views.NEAR) & (depth < derived_views.FAR - 1e-3)
    # The floor fills the picture's upper corner: the rays meet it at one height.
    corner = cloud[:4, :4][inside[:4, :4]]
    assert len(corner) and np.ptp(corner[:, 2]) < 1e-3 and abs(corner[0, 2]) < 0.02

    # A lens to the right sees near things farther to the left.
    moved = derived_views.displaced(m, derived_views.parse("camera_right", ["camera"]))
    shift = moved.camera("camera").pos - m.camera("camera").pos
    np.testing.assert_allclose(np.linalg.norm(shift), derived_views.BASELINE)
    assert abs(shift @ (0, 1, 0)) == pytest.approx(derived_views.BASELINE)  # along the image's x
    assert callable(render.make(moved, "camera", SIZE, SIZE))


BOARD = """
<mujoco>
  <asset>
    <texture name="ground" type="2d" builtin="checker" rgb1=".8 .8 .7" rgb2=".7 .7 .6" width="8"
      height="8"/>
    <material name="ground" texture="ground" texrepeat="9 9" specular="0"/>
  </asset>
  <worldbody>
    <light directional="true" pos="0 0 1" dir="-.3 .4 -1"/>
    <camera name="camera" pos="0 -.2 .25" xyaxes="1 0 0 0 .78 .62" fovy="45"/>
    <geom type="plane" size=".2 .2 .01" material="ground"/>
    <geom type="box" size=".03 .04 .01" pos="0 0 .01" rgba=".2 .4 .6 1"/>
  </worldbody>
</mujoco>
"""


def drawn(look, lower=None, has_look=None):
    """A board's image and geoms by a fixed camera, or by one that is moved down by some m.

    With `has_look` it is an image of a look that varies.
    """
    m = mujoco.MjModel.from_xml_string(BOARD)
    data = mujoco.MjData(m)
    mujoco.mj_kinematics(m, data)
    mujoco.mj_camlight(m, data)
    moves = lower is not None
    varies = has_look is not None
    draw = render.make(
        m, "camera", 64, 64, segmentation=True, moves=moves, look=look, look_varies=varies
    )
    inputs = [np.float32(x) for x in (data.geom_xpos, data.geom_xmat.reshape(-1, 3, 3))]
    inputs.append(render.geom_rgb(m))
    if lower is not None:
        down = data.cam_xpos[0] - [0.0, 0.0, lower]
        inputs.append(Pose(*map(np.float32, (data.cam_xmat[0].reshape(3, 3), down))))
    image = jax.jit(draw)(*inputs, *([jnp.array(has_look)] if varies else []))
    return np.asarray(image.rgb, int), np.asarray(image.segmentation)


def test_tissue_changes_the_ground_and_dims_the_rest_by_one_lamp():
    plain, geoms = drawn("")
    cavity, same = drawn(tissue.NAME)
    np.testing.assert_array_equal(geoms, same)
    red, green, blue = cavity[geoms == 0].mean(0)
    assert red > 1.5 * max(green, blue) and np.ptp(plain[geoms == 0].mean(0)) < 40
    assert cavity[geoms == 0].std(0).min() > 2 * plain[geoms == 0].std(0).min()  # it has a pattern
    board = geoms == 1
    factor = cavity[board].sum(-1, keepdims=True) / plain[board].sum(-1, keepdims=True)
    np.testing.assert_allclose(cavity[board], factor * plain[board], atol=2.0)  # bytes
    rows = np.nonzero(board)[0]
    near, far = (factor[rows == row].mean() for row in (rows.max(), rows.min()))
    assert near > 1.1 * far  # the lamp is at the lens


def test_tissue_stays_on_the_ground_and_the_lamp_follows_the_camera():
    fixed, geoms = drawn(tissue.NAME)
    moving, same = drawn(tissue.NAME, 0.0)
    assert (geoms == same).mean() > 0.999
    assert (np.abs(fixed - moving).max(-1) <= 2).mean() > 0.99
    lower, seen = drawn(tissue.NAME, 0.02)
    assert np.abs(lower[seen == 0].mean(0) / fixed[geoms == 0].mean(0) - 1.0).max() < 0.4
    assert (np.abs(lower - fixed).max(-1) > 5).mean() > 0.5


@pytest.mark.parametrize("has_look", [False, True])
def test_each_image_of_a_varying_look_is_plain_or_of_tissue(has_look):
    found, _ = drawn(tissue.NAME, 0.0, has_look)
    wanted, _ = drawn(tissue.NAME if has_look else "", 0.0)
    np.testing.assert_array_equal(found, wanted)
