"""Constant geometry of all images, read once from the MuJoCo model (numpy)."""

from typing import NamedTuple

import mujoco
import numpy as np

CAPSULE, CYLINDER, BOX, PLANE = range(4)  # kinds, in this order; a sphere is a capsule of length 0
FACES = (1, 2, 3, 1)  # faces that the camera can see of one: round; side, disc; x, y, z; top
_KIND_OF = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): CAPSULE,
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): CAPSULE,
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): CYLINDER,
    int(mujoco.mjtGeom.mjGEOM_BOX): BOX,
    int(mujoco.mjtGeom.mjGEOM_PLANE): PLANE,
}


class Light(NamedTuple):
    """A directional light; colours are RGB in [0, 1].

    Attributes:
      direction: `[3]` unit vector along which the light travels, in the frame of the scene.
    """

    direction: np.ndarray
    ambient: np.ndarray
    diffuse: np.ndarray
    specular: np.ndarray


class Texture(NamedTuple):
    """A picture on the top of a plane or box that is fixed in the world.

    Attributes:
      texels: `[h, w, 3]` RGB.
      scale: `[2]` texture coordinates per metre along the geom's x and y.
      corner: `[2]` m, the point at texture coordinates 0.
      R_cam_geom, p_cam_top: `[3, 3]` and `[3]` m, pose of the textured face in the frame of the
        scene: the camera's, or the world's for a camera that moves.
    """

    texels: np.ndarray
    scale: np.ndarray
    corner: np.ndarray
    R_cam_geom: np.ndarray
    p_cam_top: np.ndarray


class RenderScene(NamedTuple):
    """Drawn geoms in rows sorted by kind, the camera and its lights.

    Pixels refer to faces, which are numbered row by row, `FACES[kind]` per row.

    Attributes:
      ids: `[N]` geom id of every row.
      kind: `[N]` CAPSULE, CYLINDER, BOX or PLANE.
      axes: `[N, 3]` half-sizes of the box that, rounded by `rounding`, holds the shape; m.
      rounding: `[N]` m.
      size: `[N, 3]` radius, half-length and 0, or the half-sizes of a box or plane; m.
      rgb, specular, exponent, emission: `[N, 3]` and `[N]` material, as MuJoCo defines it.
      textures: by row.
      R_world_cam, p_world_cam: camera pose (x right, y up, it looks along -z); m.
      left, right, bottom, top: the picture's sides in the plane at depth 1.
      sun: the first directional light, or None.
      headlight: shines along the view.
      background: `[3]` RGB of rays without a hit.
    """

    ids: np.ndarray
    kind: np.ndarray
    axes: np.ndarray
    rounding: np.ndarray
    size: np.ndarray
    rgb: np.ndarray
    specular: np.ndarray
    exponent: np.ndarray
    emission: np.ndarray
    textures: dict[int, Texture]
    R_world_cam: np.ndarray
    p_world_cam: np.ndarray
    left: float
    right: float
    bottom: float
    top: float
    sun: Light | None
    headlight: Light
    background: np.ndarray

    @property
    def ground(self) -> int:
        """Returns the last row with a texture: planes follow the other kinds."""
        return max(self.textures)

    def rows(self, kind: int) -> slice:
        """Returns the rows of one kind."""
        start, stop = np.searchsorted(self.kind, (kind, kind + 1))
        return slice(int(start), int(stop))

    def first_face(self, kind: int) -> int:
        """Returns the number of the first face of a kind."""
        return int(np.sum(np.take(FACES, self.kind[self.kind < kind])))

    def row_of_face(self) -> np.ndarray:
        """Returns the row `[F]` of every face."""
        return np.repeat(np.arange(len(self.kind)), np.take(FACES, self.kind))


def read(mj_model: mujoco.MjModel, camera: str, aspect: float, moves: bool = False) -> RenderScene:
    """Reads the scene.

    Args:
      mj_model: the model.
      camera: name of the camera.
      aspect: width over height, for cameras given by `fovy` alone.
      moves: True if the camera's pose comes with every image. Sun and textures are then in the
        world's frame; else in the camera's, which must be fixed in the world.
    """
    cam = mujoco.mj_name2id(mj_model, mujoco.mjtObj.mjOBJ_CAMERA, camera)
    if cam < 0:
        names = [mj_model.camera(i).name for i in range(mj_model.ncam)]
        raise ValueError(f"camera: expected one of {names}, got {camera!r}")
    if mj_model.cam_bodyid[cam] != 0 and not moves:
        raise ValueError(f"camera: expected one fixed in the world, got {camera!r} on a body")
    data = mujoco.MjData(mj_model)
    mujoco.mj_kinematics(mj_model, data)
    mujoco.mj_camlight(mj_model, data)
    R_world_cam, p_world_cam = data.cam_xmat[cam].reshape(3, 3), data.cam_xpos[cam].copy()
    frame = (np.eye(3), np.zeros(3)) if moves else (R_world_cam, p_world_cam)

    alpha = _rgba(mj_model)[:, 3]
    drawn = [g for g in range(mj_model.ngeom) if mj_model.geom_group[g] < 3 and alpha[g] > 0]
    for g in drawn:
        if int(mj_model.geom_type[g]) not in _KIND_OF:
            shape = mujoco.mjtGeom(mj_model.geom_type[g]).name
            raise ValueError(f"geom {mj_model.geom(g).name!r}: cannot draw a {shape}")
    if not drawn:
        raise ValueError(
            "geoms: expected one that is drawn, of groups 0 to 2 and not fully transparent, "
            f"got none of {mj_model.ngeom}"
        )
    kind_of = {g: _KIND_OF[int(mj_model.geom_type[g])] for g in drawn}
    ids = np.array(sorted(drawn, key=lambda g: (kind_of[g], g)), int)  # by kind: each is one loop
    kind = np.array([kind_of[g] for g in ids])
    size, axes, rounding = _sizes(mj_model, ids, kind)
    specular, shininess, emission = _materials(mj_model, ids)
    left, right, bottom, top = _frustum(mj_model, cam, aspect)
    head = mj_model.vis.headlight
    lit = np.float32(head.active != 0)
    return RenderScene(
        ids=ids,
        kind=kind,
        axes=axes,
        rounding=rounding,
        size=size,
        rgb=_rgba(mj_model)[ids, :3],
        specular=specular,
        exponent=128 * shininess,
        emission=emission,
        textures=_textures(mj_model, data, ids, *frame),
        R_world_cam=R_world_cam,
        p_world_cam=p_world_cam,
        left=left,
        right=right,
        bottom=bottom,
        top=top,
        sun=_sun(mj_model, data, frame[0]),
        headlight=Light(
            np.array([0.0, 0.0, -1.0]), lit * head.ambient, lit * head.diffuse, lit * head.specular
        ),
        background=_sky(mj_model),
    )


def geom_rgb(mj_model: mujoco.MjModel) -> np.ndarray:
    """Returns the MJCF's colour of every geom, `[G, 3]` float32 in [0, 1]."""
    return _rgba(mj_model)[:, :3].astype(np.float32)


def _rgba(mj_model: mujoco.MjModel) -> np.ndarray:
    """Returns MuJoCo's colours: a geom's rgba overrides its material's unless it is the default."""
    rgba = mj_model.geom_rgba.copy()
    # MuJoCo's grey
    default = np.isclose(rgba, [0.5, 0.5, 0.5, 1.0]).all(1) & (mj_model.geom_matid >= 0)
    rgba[default] = mj_model.mat_rgba[mj_model.geom_matid[default]]
    return rgba


def _sizes(mj_model, ids, kind) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns sizes by row, and the rounded box around each shape."""
    size = mj_model.geom_size[ids].copy()
    size[mj_model.geom_type[ids] == mujoco.mjtGeom.mjGEOM_SPHERE, 1] = 0
    size[np.isin(kind, (CAPSULE, CYLINDER)), 2] = 0
    plane = kind == PLANE
    size[plane, :2] = np.where(size[plane, :2] > 0, size[plane, :2], 1e3)  # 0 means infinite
    size[plane, 2] = 0
    radius, half = size[:, 0], size[:, 1]
    zero = np.zeros_like(radius)
    long = np.stack([np.where(kind == CYLINDER, radius, 0)] * 2 + [half], axis=1)
    axes = np.where(np.isin(kind, (CAPSULE, CYLINDER))[:, None], long, size)
    return size, axes, np.where(kind == CAPSULE, radius, zero)


def _materials(mj_model, ids) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns specular, shininess and emission by row; MuJoCo's defaults without a material."""
    mat = mj_model.geom_matid[ids]
    if mj_model.nmat == 0:
        return np.full(len(ids), 0.5), np.full(len(ids), 0.5), np.zeros(len(ids))
    return (
        np.where(mat >= 0, mj_model.mat_specular[mat], 0.5),
        np.where(mat >= 0, mj_model.mat_shininess[mat], 0.5),
        np.where(mat >= 0, mj_model.mat_emission[mat], 0.0),
    )


def _frustum(mj_model, cam: int, aspect: float) -> tuple[float, float, float, float]:
    """Returns the image's sides at depth 1, with a sensor's shifted principal point if given."""
    width, height = mj_model.cam_sensorsize[cam]
    if height > 0:
        fx, fy, cx, cy = mj_model.cam_intrinsic[cam]
        return (
            -(width / 2 - cx) / fx,
            (width / 2 + cx) / fx,
            -(height / 2 + cy) / fy,
            (height / 2 - cy) / fy,
        )
    top = float(np.tan(np.radians(mj_model.cam_fovy[cam]) / 2))  # half height at depth 1
    return -top * aspect, top * aspect, -top, top


def _sun(mj_model, data, R_world_cam) -> Light | None:
    """Returns the first active directional light."""
    for i in range(mj_model.nlight):
        directional = mj_model.light_type[i] == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
        if mj_model.light_active[i] and directional:
            return Light(
                R_world_cam.T @ data.light_xdir[i],
                mj_model.light_ambient[i].copy(),
                mj_model.light_diffuse[i].copy(),
                mj_model.light_specular[i].copy(),
            )
    return None


def _texels(mj_model, tex: int) -> np.ndarray:
    """Returns a texture's RGB, `[h, w, 3]` in [0, 1]."""
    h, w, c = mj_model.tex_height[tex], mj_model.tex_width[tex], mj_model.tex_nchannel[tex]
    start = mj_model.tex_adr[tex]
    texels = mj_model.tex_data[start : start + h * w * c].reshape(h, w, c)
    return texels[..., :3].astype(np.float64) / 255


def _sky(mj_model) -> np.ndarray:
    """Returns the mean colour of the skybox, black without one."""
    for tex in range(mj_model.ntex):
        if mj_model.tex_type[tex] == mujoco.mjtTexture.mjTEXTURE_SKYBOX:
            return _texels(mj_model, tex).mean((0, 1))
    return np.zeros(3)


def _textures(mj_model, data, ids, R_world_cam, p_world_cam) -> dict[int, Texture]:
    """Returns the textures of rows whose material has one, mapped as MuJoCo maps 2d textures."""
    textures = {}
    for row, g in enumerate(ids):
        mat = mj_model.geom_matid[g]
        tex = mj_model.mat_texid[mat, mujoco.mjtTextureRole.mjTEXROLE_RGB] if mat >= 0 else -1
        if tex < 0:
            continue
        name, shape = mj_model.geom(g).name, _KIND_OF[int(mj_model.geom_type[g])]
        flat = mj_model.tex_type[tex] == mujoco.mjtTexture.mjTEXTURE_2D
        if not flat or shape not in (BOX, PLANE) or mj_model.geom_bodyid[g] != 0:
            raise ValueError(
                f"geom {name!r}: expected a 2d texture on a plane or box of the world body"
            )
        size, signs = mj_model.geom_size[g], np.array([1, -1])
        scale = 0.5 * mj_model.mat_texrepeat[mat] * signs
        if not mj_model.mat_texuniform[mat]:
            scale = scale / size[:2]
        R_world_geom = data.geom_xmat[g].reshape(3, 3)
        top = data.geom_xpos[g] + R_world_geom[:, 2] * size[2] * (shape == BOX)
        textures[row] = Texture(
            _texels(mj_model, tex), scale, -size[:2] * signs, R_world_cam.T @ R_world_geom,
            R_world_cam.T @ (top - p_world_cam),
        )  # fmt: skip
    return textures
