"""Draws a simulated scene on the page: two short messages a mesh and moment."""

from collections.abc import Callable
from typing import Any, NamedTuple

import mujoco
import numpy as np

from starjax.sim.camera import geometry
from starjax.viewer import shapes

_CELL, _SECTION = 0.01, 0.05  # m, squares of a grid
# Of colours: viser's own lights are brighter than the simulator's. Others would flicker whenever an
# embedded playback begins again.
_DIM = 0.45
_ABOVE = 2e-4  # m, of a grid over its plane

# (qpos `[Q]`, p_world_trocar `[A, 3]` m, rgb `[G, 3]` in [0, 1], or None for the last ones)
Show = Callable[[np.ndarray, np.ndarray, np.ndarray | None], None]


class Poses(NamedTuple):
    """World poses of all geoms G: `p` `[G, 3]` m, `R` `[G, 3, 3]`, `wxyz` `[G, 4]`."""

    p: np.ndarray
    R: np.ndarray
    wxyz: np.ndarray


def kinematics(m: mujoco.MjModel) -> Callable[[np.ndarray, np.ndarray], Poses]:
    """Makes (qpos `[Q]`, p_world_trocar `[A, 3]` m) -> Poses."""
    data = mujoco.MjData(m)
    bodies = [m.body(b) for b in range(m.nbody)]
    trocars = [int(b.mocapid[0]) for b in bodies if b.mocapid[0] >= 0]

    def poses(qpos: np.ndarray, p_world_trocar: np.ndarray) -> Poses:
        data.qpos[:] = qpos
        data.mocap_pos[trocars[: len(p_world_trocar)]] = p_world_trocar
        mujoco.mj_kinematics(m, data)
        wxyz = np.zeros((m.ngeom, 4))
        for g in range(m.ngeom):
            mujoco.mju_mat2Quat(wxyz[g], data.geom_xmat[g])
        return Poses(data.geom_xpos.copy(), data.geom_xmat.reshape(-1, 3, 3).copy(), wxyz)

    return poses


def add(scene: Any, m: mujoco.MjModel, root: str) -> Show:
    """Adds the model's geoms below the node `root`; returns what moves them.

    Args:
      scene: `viser.SceneApi`.
    """
    poses, parts = kinematics(m), shapes.read(m)
    rgb = geometry.geom_rgb(m)
    trocars = np.array([b.pos for b in map(m.body, range(m.nbody)) if b.mocapid[0] >= 0])
    first = poses(m.qpos0, trocars)
    handles = {}
    for name, part in parts.items():
        handles[name] = scene.add_batched_meshes_simple(
            f"{root}/{name}",
            part.vertices,
            part.faces,
            first.wxyz[part.geom].astype(np.float32),
            _places(part, first),
            batched_scales=part.scale.astype(np.float32),
            batched_colors=_bytes(rgb[part.geom]),
            lod="off",
        )
    for g in np.flatnonzero(m.geom_type == mujoco.mjtGeom.mjGEOM_PLANE):
        _add_grid(scene, f"{root}/grid{g}", m.geom_size[g], first.p[g], first.wxyz[g])
    shown = {"rgb": rgb}

    def show(qpos: np.ndarray, p_world_trocar: np.ndarray, rgb: np.ndarray | None) -> None:
        now = poses(qpos, p_world_trocar)
        is_new = rgb is not None and not np.array_equal(rgb, shown["rgb"])
        for name, part in parts.items():
            handles[name].batched_wxyzs = now.wxyz[part.geom].astype(np.float32)
            handles[name].batched_positions = _places(part, now)
            if rgb is not None and is_new:
                handles[name].batched_colors = _bytes(rgb[part.geom])
        if rgb is not None:
            shown["rgb"] = rgb

    return show


def _add_grid(scene: Any, name: str, size: np.ndarray, p: np.ndarray, wxyz: np.ndarray) -> None:
    """Squares on a plane, which show its scale."""
    width, height = (2.0 * float(half) if half > 0 else 1.0 for half in size[:2])
    scene.add_grid(
        name,
        width,
        height,
        cell_size=_CELL,
        section_size=_SECTION,
        cell_color=(176, 169, 152),
        section_color=(150, 143, 126),
        shadow_opacity=0.0,
        position=p + np.array([0.0, 0.0, _ABOVE]),
        wxyz=wxyz,
    )


def _places(part: shapes.Instances, poses: Poses) -> np.ndarray:
    """`[K, 3]` m, of instances in the world."""
    turned = np.einsum("kij,kj->ki", poses.R[part.geom], part.offset)
    return (poses.p[part.geom] + turned).astype(np.float32)


def _bytes(rgb: np.ndarray) -> np.ndarray:
    return np.clip(255.0 * _DIM * rgb + 0.5, 0, 255).astype(np.uint8)
