"""The ray caster against MuJoCo: its ray functions always, its GL renderer if GL works."""

import functools
import os
import pathlib
import subprocess
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from starjax import rcm
from starjax.core import errors
from starjax.core.types import Pose
from starjax.sim import render
from starjax.sim import scene as model
from starjax.sim.arms import fr5
from starjax.sim.camera import geometry as scenes
from starjax.sim.camera import rays, tiles

# Every primitive, tilted, in a pile, with hidden geoms: groups 3 and up, alpha 0, sites.
PILE = """
<mujoco>
  <visual>
    <headlight ambient=".3 .3 .3" diffuse=".3 .3 .3" specular=".2 .2 .2"/>
    <quality shadowsize="8192" offsamples="0"/><map znear=".01"/>
  </visual>
  <statistic center="0 0 0.1" extent="0.5"/>
  <asset>
    <texture name="grid" type="2d" builtin="checker" rgb1=".8 .8 .7" rgb2=".7 .7 .7" mark="edge"
      markrgb=".5 .5 .5" width="64" height="64"/>
    <material name="grid" texture="grid" texrepeat="8 6" specular="0"/>
    <material name="shiny" rgba=".2 .5 .8 1" specular=".8" shininess=".3" emission=".1"/>
  </asset>
  <worldbody>
    <light directional="true" pos=".2 -.3 1" dir="-.3 .4 -1" diffuse=".6 .6 .5"
      specular=".3 .3 .3"/>
    <camera name="camera" pos="0 -.5 .35" xyaxes="1 0 0 0 .6 .8" fovy="45"/>
    <camera name="shifted" pos="0 -.5 .35" xyaxes="1 0 0 0 .6 .8" resolution="128 96"
      sensorsize=".004 .003" focalpixel="200 190" principalpixel="20 -30"/>
    <geom type="plane" size=".3 .2 .01" material="grid"/>
    <geom type="box" size=".1 .08 .01" pos=".1 .1 .01" material="grid"/>
    <geom type="box" size=".05 .05 .05" pos="0 0 .1" group="3"/>
    <geom type="sphere" size=".3" pos="0 0 .1" rgba="1 0 0 0"/>
    <site size=".1" pos="0 0 .1"/>
    {bodies}
  </worldbody>
</mujoco>
"""
SHAPES = {
    "sphere": ".02",
    "capsule": ".012 .04",
    "cylinder": ".02 .03",
    "box": ".015 .03 .02",
}


@functools.cache
def pile(copies: int = 2, marks: bool = True) -> mujoco.MjModel:
    """The pile, `copies` of each shape on a free body; lines mark the edges of its checkers."""
    bodies = ""
    for kind, size in SHAPES.items():
        for i in range(copies):
            look = 'material="shiny"' if i % 2 else f'rgba="{0.2 + 0.3 * i} .5 .3 1"'
            bodies += f'<body><freejoint/><geom type="{kind}" size="{size}" {look}/></body>'
    xml = PILE if marks else PILE.replace('mark="edge"', "")
    return mujoco.MjModel.from_xml_string(xml.format(bodies=bodies))


@functools.cache
def composed() -> mujoco.MjModel:
    """The scene of peg transfer."""
    return model.compose(model.name())


def poses(mj_model: mujoco.MjModel, n: int, seed: int = 0) -> np.ndarray:
    """`[n, nq]` configurations: free bodies anywhere above the board, the arm near home."""
    rng = np.random.default_rng(seed)
    qpos = np.tile(mj_model.qpos0, (n, 1))
    for joint, at in zip(mj_model.jnt_type, mj_model.jnt_qposadr):
        if joint == mujoco.mjtJoint.mjJNT_FREE:
            spread = (0.15, 0.12, 0.1) if mj_model.njnt > 9 or mj_model.nu == 0 else (0.03,) * 3
            qpos[:, at : at + 3] = rng.uniform(-1, 1, (n, 3)) * spread + (0, 0, 0.1)
            quat = rng.normal(size=(n, 4))
            qpos[:, at + 3 : at + 7] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    for k, home in enumerate(fr5.ARM.mounts["grasper", "board"].home):
        name = f"arm0/j{k + 1}"
        if mujoco.mj_name2id(mj_model, mujoco.mjtObj.mjOBJ_JOINT, name) >= 0:
            qpos[:, mj_model.joint(name).qposadr[0]] = home + rng.normal(scale=0.06, size=n)
    return qpos


def geoms(mj_model: mujoco.MjModel, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses of all geoms, `[n, G, 3]` and `[n, G, 3, 3]` float32."""
    data, xpos, xmat = mujoco.MjData(mj_model), [], []
    for q in qpos:
        data.qpos[:] = q
        mujoco.mj_kinematics(mj_model, data)
        xpos.append(data.geom_xpos.copy())
        xmat.append(data.geom_xmat.reshape(-1, 3, 3).copy())
    return np.array(xpos, np.float32), np.array(xmat, np.float32)


@functools.cache
def caster(mj_model: mujoco.MjModel, **settings):
    """The compiled caster over a batch of poses; small pictures with everything by default."""
    settings = {"height": 60, "width": 80, "depth": True, "segmentation": True, **settings}
    return jax.jit(jax.vmap(render.make(mj_model, **settings), in_axes=(0, 0, None)))


def draw(mj_model: mujoco.MjModel, qpos: np.ndarray, **settings) -> render.CameraImage:
    """Our pictures of `[n, nq]` configurations."""
    take = caster(mj_model, **settings)
    return jax.tree.map(np.asarray, take(*geoms(mj_model, qpos), render.geom_rgb(mj_model)))


def cast(mj_model, qpos, points, directions) -> tuple[np.ndarray, np.ndarray]:
    """C rays: the geom met first (-1 none) and how many `directions` away, `[n]` each."""
    data = mujoco.MjData(mj_model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(mj_model, data)
    groups = np.array([1, 1, 1, 0, 0, 0], np.uint8)
    geom, hit = np.full(1, -1, np.int32), []
    for point, direction in zip(points, directions):
        t = mujoco.mj_ray(mj_model, data, point, direction, groups, 1, -1, geom)
        hit.append((geom[0], t))
    ids, t = np.array(hit).T
    return ids.astype(int), t


def view_rays(
    mj_model, camera: str, height: int = 60, width: int = 80
) -> tuple[np.ndarray, np.ndarray]:
    """Camera position `[3]` and world rays of unit depth through all pixel centres, `[h w, 3]`."""
    scene = scenes.read(mj_model, camera, width / height)
    x = scene.left + (np.arange(width) + 0.5) / width * (scene.right - scene.left)
    y = scene.top + (np.arange(height) + 0.5) / height * (scene.bottom - scene.top)
    grid = np.stack([*np.meshgrid(x, y), -np.ones((height, width))], -1).reshape(-1, 3)
    return scene.p_world_cam, grid @ scene.R_world_cam.T


@pytest.mark.parametrize("camera", ["camera", "shifted"])
def test_geom_and_depth_agree_with_mujoco_rays(camera):
    mj_model = pile()
    qpos = poses(mj_model, 3)
    frames = draw(mj_model, qpos, camera=camera)
    p_world_cam, directions = view_rays(mj_model, camera)
    for i, q in enumerate(qpos):
        ids, t = cast(mj_model, q, np.broadcast_to(p_world_cam, directions.shape), directions)
        ours = frames.segmentation[i].ravel()
        assert len(np.unique(ids)) >= 8, "the picture shows too little to compare"
        assert np.mean(ours == ids) >= 0.999
        both = (ours == ids) & (ids >= 0)
        error = np.abs(frames.depth[i].ravel() - t)[both]
        assert error.mean() <= 5e-6 and np.percentile(error, 99) <= 5e-5
        assert (frames.depth[i].ravel()[ours < 0] == rays.FAR).all()


def test_shadow_agrees_with_mujoco_rays():
    mj_model = pile.__wrapped__()
    for part in (mj_model.vis.headlight.ambient, mj_model.vis.headlight.diffuse):
        part[:] = 0
    mj_model.vis.headlight.specular[:] = 0
    mj_model.light_specular[:] = 0
    mj_model.mat_emission[:] = 0
    mj_model.light_diffuse[:] = 1
    qpos = poses(mj_model, 3, seed=1)
    frames = draw(mj_model, qpos)
    p_world_cam, directions = view_rays(mj_model, "camera")
    data = mujoco.MjData(mj_model)
    mujoco.mj_forward(mj_model, data)
    to_light = -data.light_xdir[0]
    for i, q in enumerate(qpos):
        seen = frames.segmentation[i].ravel() >= 0
        points = (
            p_world_cam + frames.depth[i].ravel()[seen, None] * directions[seen] + 3e-5 * to_light
        )
        hidden, _ = cast(mj_model, q, points, np.broadcast_to(to_light, points.shape))
        dark = frames.rgb[i].reshape(-1, 3)[seen].max(-1) == 0
        assert 0.05 < dark.mean() < 0.7, "too little shadow to compare"
        assert np.mean(dark == (hidden >= 0)) >= 0.998


@pytest.fixture(scope="module")
def gl_pictures(tmp_path_factory):
    """The C renderer: `take(mj_model, qpos, camera, height, width)`; skips without GL."""
    folder = tmp_path_factory.mktemp("gl")

    def take(mj_model, qpos, camera, height, width):
        mujoco.mj_saveModel(mj_model, str(folder / "model.mjb"), None)
        np.savez(folder / "qpos.npz", qpos=qpos)
        script = pathlib.Path(__file__).with_name("gl_renderer.py")
        files = [str(folder / name) for name in ("model.mjb", "qpos.npz", "out.npz")]
        command = [sys.executable, str(script), *files, camera, str(height), str(width), "128"]
        for backend in ("egl", "osmesa"):
            environment = {**os.environ, "MUJOCO_GL": backend}
            done = subprocess.run(command, env=environment, capture_output=True, text=True)
            if done.returncode == 0:
                with np.load(files[2]) as pictures:
                    return dict(pictures)
        pytest.skip(f"no GL here (neither EGL nor OSMesa): {done.stderr.strip()[-200:]}")

    return take


@pytest.mark.parametrize(
    ("compose", "camera", "height", "width"),
    [
        (pile, "camera", 144, 208),
        (pile, "shifted", 192, 256),
        (composed, "camera", 256, 256),
    ],
)
def test_agrees_with_the_gl_renderer(gl_pictures, compose, camera, height, width):
    mj_model = compose()
    qpos = poses(mj_model, 3)
    theirs = gl_pictures(mj_model, qpos, camera, height, width)
    ours = draw(mj_model, qpos, camera=camera, height=height, width=width)
    same = ours.segmentation == theirs["segmentation"]
    both = same & (ours.segmentation >= 0)
    assert same.mean((1, 2)).min() >= 0.999
    assert np.abs(ours.depth - theirs["depth"])[both].mean() <= 5e-5
    assert np.abs(ours.rgb.astype(float) - theirs["rgb"]).mean() <= 3.0


@pytest.mark.slow
def test_culling_never_changes_a_picture(monkeypatch):
    mj_model = pile(9)  # 36 moving geoms and more than 32 of the round kinds: two words of bits
    qpos = poses(mj_model, 2, seed=2)
    culled = draw(mj_model, qpos)
    caster.cache_clear()
    monkeypatch.setattr(tiles, "in_view", lambda grid, c, *_: jnp.ones((len(grid.x), len(c)), bool))
    monkeypatch.setattr(tiles, "over", lambda low, _, c, *__: jnp.ones((len(low), len(c)), bool))
    everything = draw(mj_model, qpos)
    caster.cache_clear()
    # Not bit by bit: loops over more or fewer tiles compile to roundings of their own.
    assert np.mean(culled.segmentation != everything.segmentation) < 1e-3
    assert np.mean((culled.rgb != everything.rgb).any(-1)) < 3e-3
    assert np.mean(np.abs(culled.depth - everything.depth) > 1e-5) < 1e-3


def test_a_broken_environment_leaves_its_neighbours_alone():
    mj_model = pile()
    xpos, xmat = geoms(mj_model, poses(mj_model, 3))
    take, rgb = caster(mj_model), render.geom_rgb(mj_model)
    before = np.asarray(take(xpos, xmat, rgb).rgb)
    xpos[1], xmat[1, 4:] = np.nan, 1e20
    after = np.asarray(take(xpos, xmat, rgb).rgb)
    assert (before[[0, 2]] == after[[0, 2]]).all()


def test_colours_are_an_argument():
    mj_model = pile()
    xpos, xmat = geoms(mj_model, poses(mj_model, 3))
    take, rgb = caster(mj_model), render.geom_rgb(mj_model)
    before = take(xpos, xmat, rgb)
    moving = before.segmentation[before.segmentation >= 4]
    geom = int(np.bincount(moving).argmax())
    rgb[geom] = (0, 1, 0)
    after = take(xpos, xmat, rgb)
    changed = np.asarray((before.rgb != after.rgb).any(-1))
    assert changed.any() and (np.asarray(before.segmentation)[changed] == geom).all()


def test_a_scene_needs_not_have_every_shape():
    mj_model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><light directional="true"/>
          <camera name="camera" pos="0 0 1"/><geom type="plane" size="1 1 .1" rgba="0 0 1 1"/>
          <body pos="0 0 .2"><freejoint/><geom type="sphere" size=".1" rgba="1 0 0 1"/></body>
        </worldbody></mujoco>"""
    )
    xpos, xmat = geoms(mj_model, mj_model.qpos0[None])
    take = jax.jit(render.make(mj_model, "camera", 16, 16))
    rgb = np.asarray(take(xpos[0], xmat[0], render.geom_rgb(mj_model)).rgb).astype(int)
    assert rgb[8, 8, 0] > rgb[8, 8, 2] and rgb[0, 0, 2] > rgb[0, 0, 0]


def test_what_is_hidden_is_not_drawn():
    frame = draw(pile(), poses(pile(), 3))
    assert not np.isin(frame.segmentation, (2, 3)).any()


def test_one_picture_is_the_same_alone_as_in_a_batch():
    mj_model = pile()
    qpos = poses(mj_model, 3)
    xpos, xmat = geoms(mj_model, qpos)
    take, rgb = render.make(mj_model, height=60, width=80), render.geom_rgb(mj_model)
    alone = jax.jit(lambda xpos, xmat: take(xpos, xmat, rgb))(xpos[1], xmat[1])
    assert alone.depth is None and alone.segmentation is None and alone.rgb.dtype == np.uint8
    difference = np.abs(draw(mj_model, qpos).rgb[1].astype(int) - alone.rgb)
    assert np.mean(difference > 1) < 1e-3  # fused otherwise, an outline may fall otherwise


@pytest.mark.slow
def test_supersampling_smooths_outlines_and_nothing_else():
    mj_model = pile()
    qpos = poses(mj_model, 3)
    one, four = (draw(mj_model, qpos, samples=s) for s in (1, 2))
    difference = np.abs(one.rgb.astype(int) - four.rgb).max(-1)
    assert 0.005 < np.mean(difference > 8) < 0.2
    assert np.mean(one.segmentation == four.segmentation) > 0.97


def test_the_nominal_trocar_is_on_the_optical_axis():
    """The principal point lies 117 px above the middle of the image, and the trocar on it."""
    mj_model = composed()
    xpos, xmat = geoms(mj_model, mj_model.qpos0[None])
    marker = mj_model.geom("trocar0").id
    frame = jax.jit(render.make(mj_model, segmentation=True))(
        xpos[0], xmat[0], render.geom_rgb(mj_model)
    )
    rows, columns = np.nonzero(np.asarray(frame.segmentation) == marker)
    assert abs(columns.mean() - 127.5) < 0.5 and abs(rows.mean() - (127.5 - 117)) < 1.5


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"camera": "nowhere"}, "camera: expected one of"),
        ({"height": 0}, "height: expected a positive"),
        ({"samples": 3}, "samples: expected 1, 2 or 4"),
    ],
)
def test_wrong_settings_are_named(settings, words):
    with pytest.raises(ValueError, match=words):
        render.make(pile(), **settings)


@pytest.mark.parametrize(
    ("geoms", "count"),
    [
        ("", 0),
        ('<geom size=".1" rgba="1 0 0 0"/><geom size=".1" group="3"/>', 2),
    ],
)
def test_a_scene_with_nothing_to_draw_is_named(geoms, count):
    mj_model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><camera name="camera" pos="0 0 1"/>{geoms}</worldbody></mujoco>'
    )
    with pytest.raises(ValueError, match=f"geoms: expected one .* got none of {count}$"):
        render.make(mj_model, height=8, width=8)


def test_wrong_shapes_are_named():
    caster = render.make(pile(), height=8, width=8)
    with pytest.raises(ValueError, match="geom_xpos, geom_xmat, geom_rgb: expected"):
        caster(jnp.zeros((2, 3)), jnp.zeros((2, 3, 3)), jnp.zeros((2, 3)))


@pytest.mark.parametrize(
    "compose",
    [lambda: pile(marks=False), pytest.param(composed, marks=pytest.mark.release)],
    ids=["pile", "composed"],
)
def test_a_moving_camera_sees_what_a_fixed_one_sees_from_there(compose):
    mj_model = compose()
    qpos = poses(mj_model, 2)
    fixed = draw(mj_model, qpos, segmentation=True, height=96, width=96)
    scene = scenes.read(mj_model, "camera", 1.0)
    here = Pose(jnp.asarray(scene.R_world_cam), jnp.asarray(scene.p_world_cam))
    take = render.make(mj_model, segmentation=True, height=96, width=96, moves=True)
    rgb = render.geom_rgb(mj_model)
    xpos, xmat = geoms(mj_model, qpos)
    moved = jax.jit(jax.vmap(lambda p, R: take(p, R, rgb, here)))(xpos, xmat)
    same = np.asarray(moved.segmentation) == fixed.segmentation
    assert same.mean() > 0.999
    off = np.abs(np.asarray(moved.rgb).astype(int) - fixed.rgb).max(-1)
    assert off.mean() < 0.5  # levels of 255: the edges of the checkers are smoothed otherwise


def test_a_camera_that_moves_sees_the_scene_turn():
    """Turned about the vertical with the whole of the scene, it sees the same."""
    mj_model = pile(marks=False)
    take = jax.jit(render.make(mj_model, height=64, width=64, moves=True, shadow=False))
    scene = scenes.read(mj_model, "camera", 1.0)
    xpos, xmat = (x[0] for x in geoms(mj_model, poses(mj_model, 1)))
    rgb = render.geom_rgb(mj_model)
    up = np.array([0.0, 0.0, 0.02])
    here = Pose(jnp.asarray(scene.R_world_cam), jnp.asarray(scene.p_world_cam))
    there = here._replace(p=here.p + up)
    first, second = take(xpos, xmat, rgb, here), take(xpos + up, xmat, rgb, there)
    static = np.asarray(first.rgb) == np.asarray(second.rgb)
    assert static.mean() > 0.9 and (np.asarray(take(xpos, xmat, rgb, there).rgb) != first.rgb).any()


def test_what_a_moving_camera_cannot_draw_is_refused():
    with pytest.raises(errors.UsageError):
        render.make(pile(), moves=True)


def test_compiled_bounds_of_shadows_are_those_of_numpy():
    """Of as many tiles as a large picture has: XLA for CPU once added up other numbers there."""
    count, geoms = 2304, 58
    keys = jax.random.split(jax.random.key(0), 5)
    middle = 0.3 * jax.random.uniform(keys[0], (count, 1, 3))
    half = 0.01 * jax.random.uniform(keys[1], (count, 1, 3))
    c = 0.3 * jax.random.uniform(keys[2], (geoms, 3))
    R = rcm.rot6d_decode(jax.random.normal(keys[3], (geoms, 6)))
    axes = 0.05 * jax.random.uniform(keys[4], (geoms, 3)) ** 3
    rounding = jnp.full(geoms, 1e-3)
    low, high = (middle - half)[:, 0], (middle + half)[:, 0]
    found = np.asarray(jax.jit(tiles.over)(low, high, c, R, axes, rounding))

    middle, half, c, R, axes = (np.asarray(x, float) for x in (middle, half, c, R, axes))
    spread = np.einsum("gij,gj->gi", np.abs(R), axes) + 1e-3
    off = np.abs(c - middle) - half - spread
    above = c[:, 2] + spread[:, 2] >= (middle - half)[..., 2]
    u = R[np.arange(geoms), :2, axes.argmax(-1)]
    across = np.stack([-u[:, 1], u[:, 0]], -1) / np.linalg.norm(u, axis=-1, keepdims=True)
    reach = (np.abs(np.einsum("gi,gij->gj", across, R[:, :2])) * axes).sum(-1) + 1e-3
    limit = reach + (np.abs(across) * half[..., :2]).sum(-1)
    aside = np.abs((across * (c - middle)[..., :2]).sum(-1))
    wanted = (off[..., :2] <= 0).all(-1) & above & (aside <= limit)
    assert wanted.sum() > 1000 and not (wanted & ~found).any()
    assert (found & ~wanted).sum() < 0.02 * wanted.sum()  # the slack
