"""A MuJoCo model as a few unit meshes with many instances each, as the page draws it."""

from typing import NamedTuple

import mujoco
import numpy as np
import trimesh

_HIDDEN_GROUP = 3  # geoms of this group and above are not drawn, as in the simulator's camera
_SEGMENTS = 32  # around a cylinder
_SUBDIVISIONS = 2  # for the sphere
_SHARP = 0.5  # rad between two faces, beyond which their edge is not shaded smooth
_FLAT = 2e-4  # m, half thickness of a plane
_ENDLESS = 0.5  # m, half length of an infinite plane

_KINDS = mujoco.mjtGeom


class Instances(NamedTuple):
    """All instances K of one mesh.

    Attributes:
      vertices: `[V, 3]` of the mesh.
      faces: `[F, 3]` int of the mesh.
      geom: `[K]` geom ids.
      offset: `[K, 3]` positions in m in the geom's frame.
      scale: `[K, 3]` factors.
    """

    vertices: np.ndarray
    faces: np.ndarray
    geom: np.ndarray
    offset: np.ndarray
    scale: np.ndarray


def read(m: mujoco.MjModel) -> dict[str, Instances]:
    """Returns the visible geoms by mesh: a capsule becomes a cylinder and two spheres.

    Planes become thin boxes. Kinds without a mesh, such as height fields, are skipped.
    """
    pieces: dict[str, list[tuple[int, np.ndarray, np.ndarray]]] = {}
    for g in range(m.ngeom):
        if m.geom_group[g] >= _HIDDEN_GROUP or m.geom_rgba[g, 3] == 0:
            continue
        for name, offset, scale in _parts(m, g):
            pieces.setdefault(name, []).append((g, offset, scale))
    shapes = {name: _mesh(m, name) for name in pieces}
    return {
        name: Instances(*shapes[name], *(np.array(column) for column in zip(*rows)))
        for name, rows in pieces.items()
    }


def _parts(m: mujoco.MjModel, g: int) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Returns (mesh, offset, scale) of each piece of a geom."""
    size, origin, ones = m.geom_size[g], np.zeros(3), np.ones(3)
    radius, half = size[0], np.array([0.0, 0.0, size[1]])
    match _KINDS(m.geom_type[g]):
        case _KINDS.mjGEOM_SPHERE:
            return [("sphere", origin, radius * ones)]
        case _KINDS.mjGEOM_ELLIPSOID:
            return [("sphere", origin, size.copy())]
        case _KINDS.mjGEOM_CYLINDER:
            return [("cylinder", origin, np.array([radius, radius, size[1]]))]
        case _KINDS.mjGEOM_CAPSULE:
            rod = ("cylinder", origin, np.array([radius, radius, size[1]]))
            return [rod, *(("sphere", end, radius * ones) for end in (-half, half))]
        case _KINDS.mjGEOM_BOX:
            return [("box", origin, size.copy())]
        case _KINDS.mjGEOM_PLANE:
            sides = np.where(size[:2] > 0, size[:2], _ENDLESS)
            return [("box", np.array([0.0, 0.0, -_FLAT]), np.array([*sides, _FLAT]))]
        case _KINDS.mjGEOM_MESH:
            return [(f"mesh{m.geom_dataid[g]}", origin, ones)]
    return []


def _mesh(m: mujoco.MjModel, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns vertices and faces of a mesh from -1 to 1, or of one of the model's own."""
    if name == "sphere":
        mesh = trimesh.creation.icosphere(subdivisions=_SUBDIVISIONS)
    elif name == "cylinder":
        mesh = trimesh.creation.cylinder(radius=1.0, height=2.0, sections=_SEGMENTS)
        mesh = trimesh.graph.smooth_shade(mesh, angle=_SHARP)
    elif name == "box":
        mesh = trimesh.creation.box((2.0, 2.0, 2.0))
        mesh = trimesh.graph.smooth_shade(mesh, angle=_SHARP)
    else:
        i = int(name.removeprefix("mesh"))
        vertices, faces = m.mesh_vertadr[i], m.mesh_faceadr[i]
        return (
            m.mesh_vert[vertices : vertices + m.mesh_vertnum[i]].astype(np.float32),
            m.mesh_face[faces : faces + m.mesh_facenum[i]].astype(np.uint32),
        )
    return mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32)
