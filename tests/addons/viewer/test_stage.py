"""The page draws geoms at their positions and sizes."""

import mujoco
import numpy as np
import pytest

from starjax.addons.viewer import meshes, stage
from starjax.core.types import Pose
from starjax.sim import scene

ROUND = ("mjGEOM_SPHERE", "mjGEOM_CAPSULE", "mjGEOM_CYLINDER", "mjGEOM_BOX", "mjGEOM_ELLIPSOID")


@pytest.fixture(scope="module")
def model():
    return scene.compose(scene.name("peg_transfer"))


def drawn(parts, geom):
    """All drawn points of a geom, in its frame."""
    points = [
        part.vertices * part.scale[i] + part.offset[i]
        for part in parts.values()
        for i in np.flatnonzero(part.geom == geom)
    ]
    return np.concatenate(points) if points else np.zeros((0, 3))


def test_geoms_are_as_large_as_their_bounding_spheres(model):
    """The oracle is MuJoCo's own radius of each geom's bounding sphere."""
    parts, seen = meshes.read(model), 0
    for g in range(model.ngeom):
        if mujoco.mjtGeom(model.geom_type[g]).name not in ROUND or model.geom_group[g] >= 3:
            continue
        points = drawn(parts, g)
        radius = np.linalg.norm(points, axis=1).max()
        np.testing.assert_allclose(points.max(0), -points.min(0), atol=0.01 * radius)
        assert radius == pytest.approx(model.geom_rbound[g], rel=1e-4), model.geom(g).name
        seen += 1
    assert seen > 40


def test_hidden_geoms_are_not_drawn():
    m = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><geom size='1'/><geom size='1' group='3'/>"
        "<geom size='1' rgba='1 1 1 0'/><geom type='ellipsoid' size='1 2 3'/>"
        "<geom type='plane' size='0 0 1'/></worldbody></mujoco>"
    )
    parts = meshes.read(m)
    assert list(parts["sphere"].geom) == [0, 3] and list(parts["box"].geom) == [4]
    assert np.abs(drawn(parts, 3)).max(0) == pytest.approx([1, 2, 3], rel=1e-3)


def test_meshes_are_drawn_as_they_are():
    m = mujoco.MjModel.from_xml_string(
        "<mujoco><asset><mesh name='m' vertex='0 0 0  1 0 0  0 1 0  0 0 1'/></asset>"
        "<worldbody><geom type='mesh' mesh='m'/></worldbody></mujoco>"
    )
    part = meshes.read(m)["mesh0"]
    volume = np.einsum("fi,fi->", part.vertices[part.faces[:, 0]], np.cross(*_sides(part))) / 6
    assert volume == pytest.approx(1 / 6, rel=1e-5)


def _sides(part):
    corners = part.vertices[part.faces]
    return corners[:, 1], corners[:, 2]


class Scene:
    """A stand-in for viser's scene that keeps its messages."""

    def __init__(self):
        self.sent = {}

    def add_batched_meshes_simple(self, name, vertices, faces, wxyzs, positions, **given):
        handle = type("Handle", (), {})()
        handle.batched_wxyzs, handle.batched_positions = wxyzs, positions
        handle.batched_colors = given["batched_colors"]
        self.sent[name] = handle
        return handle

    def add_grid(self, *given, **more):
        pass

    def add_frame(self, *given, **more):
        pass

    def add_line_segments(self, *given, **more):
        return type("Handle", (), {})()


def test_a_trocar_a_body_at_rest_and_a_thread_are_where_they_are_set():
    made = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody>
        <geom name="thread0" type="capsule" size="0.001 0.01" contype="0" conaffinity="0"/>
        <body name="trocar0" mocap="true"><geom name="trocar0" size="0.01"/></body>
        <body name="still0" mocap="true"><geom name="mark" size="0.01"/></body>
        </worldbody></mujoco>"""
    )
    trocar, mark = np.array([[0.0, 0.0, 0.15]]), np.array([[0.03, 0.0, 0.01]])
    points = np.array([[0.0, 0.0, 0.0], [0.02, 0.0, 0.0]])
    geoms = stage.kinematics(made)(points.ravel(), trocar, Pose(np.eye(3)[None], mark))
    for name, p in (("trocar0", trocar[0]), ("mark", mark[0]), ("thread0", points.mean(0))):
        np.testing.assert_allclose(geoms.p[made.geom(name).id], p, atol=1e-7)
    np.testing.assert_allclose(geoms.R[made.geom("thread0").id, :, 2], [1.0, 0.0, 0.0], atol=1e-7)


def test_instances_follow_the_simulation(model):
    page, data = Scene(), mujoco.MjData(model)
    drawn = stage.Stage(page, model)
    random = np.random.default_rng(0)
    qpos = model.qpos0 + 0.1 * random.normal(size=model.nq)
    trocar = np.array([[0.02, -0.01, 0.16]])
    rgb = random.uniform(size=(model.ngeom, 3))
    frame = stage.Frame(0, qpos, trocar, trocar, 0, rgb, np.zeros((0, 1, 3)), *[0] * 6)
    drawn.show(frame)
    data.qpos[:], data.mocap_pos[0] = qpos, trocar
    mujoco.mj_forward(model, data)
    box, part = page.sent["/rollout0/geoms/box"], meshes.read(model)["box"]
    for i, g in enumerate(part.geom):
        R = np.zeros(9)
        mujoco.mju_quat2Mat(R, box.batched_wxyzs[i].astype(float))
        np.testing.assert_allclose(R, data.geom_xmat[g], atol=1e-5)
        at = data.geom_xpos[g] + R.reshape(3, 3) @ part.offset[i]
        np.testing.assert_allclose(box.batched_positions[i], at, atol=1e-6)
        shade = box.batched_colors[i] / box.batched_colors[0]
        np.testing.assert_allclose(shade, rgb[g] / rgb[part.geom[0]], rtol=0.2)
    ring = model.geom("trocar0").id
    cylinder, part = page.sent["/rollout0/geoms/cylinder"], meshes.read(model)["cylinder"]
    at = cylinder.batched_positions[list(part.geom).index(ring)]
    np.testing.assert_allclose(at, trocar[0], atol=1e-6)
