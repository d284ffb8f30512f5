"""One rollout in the page's 3D view: the MuJoCo scene, the tip's path and the plan ahead."""

import collections
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np

from starjax.addons.viewer import meshes
from starjax.addons.viewer.frame import Frame
from starjax.core.types import Pose
from starjax.sim import still_bodies, thread_geoms
from starjax.sim.camera import geometry

if TYPE_CHECKING:  # for annotations alone
    import viser

_SPACING = 0.6  # m between two rollouts
_PATH_STEPS = 90  # control steps that the tip's path stays
_LINE_WIDTH = 0.0008  # m
_PATH_RGB, _PLAN_RGB = (96, 125, 139), (0, 150, 136)
_CELL, _SECTION = 0.01, 0.05  # m, squares of a grid
# Scale of colours: viser's lights are brighter than the simulator's. Changed lights would flicker
# whenever an embedded playback begins again.
_DIM = 0.45
_FOV = np.radians(60.0)  # vertical field of view of new pages
_GRID_HEIGHT = 2e-4  # m above its plane


class Stage:
    """A rollout on the page, number `i` of those side by side.

    Each step sends two short messages per mesh, however many geoms share it.
    """

    def __init__(self, scene: "viser.SceneApi", model: mujoco.MjModel, i: int = 0):
        root = f"/rollout{i}"
        self._root = scene.add_frame(root, show_axes=False, position=(0.0, _SPACING * i, 0.0))
        self._poses, self._parts = kinematics(model), meshes.read(model)
        self._rgb = geometry.geom_rgb(model)
        trocars = [b.pos for b in map(model.body, range(model.nbody)) if b.mocapid[0] >= 0]
        first = self._poses(model.qpos0, np.array(trocars))
        self._handles = {
            name: scene.add_batched_meshes_simple(
                f"{root}/geoms/{name}",
                part.vertices,
                part.faces,
                first.wxyz[part.geom].astype(np.float32),
                _positions(part, first),
                batched_scales=part.scale.astype(np.float32),
                batched_colors=_bytes(self._rgb[part.geom]),
                lod="off",
            )
            for name, part in self._parts.items()
        }
        for g in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE):
            grid = f"{root}/geoms/grid{g}"
            _add_grid(scene, grid, model.geom_size[g], first.p[g], first.wxyz[g])
        self._tips = collections.deque[np.ndarray](maxlen=_PATH_STEPS)
        blank = np.zeros((1, 2, 3), np.float32)
        add = scene.add_line_segments
        self._path = add(f"{root}/path", blank, _PATH_RGB, thickness=_LINE_WIDTH)
        self._plan = add(f"{root}/plan", blank, _PLAN_RGB, thickness=_LINE_WIDTH)

    def clear(self) -> None:
        """Clears the path."""
        self._tips.clear()

    def show(self, frame: Frame) -> None:
        """Draws a frame."""
        poses = self._poses(frame.qpos, frame.p_world_trocar, frame.still)
        is_recoloured = not np.array_equal(frame.rgb, self._rgb)
        self._rgb = frame.rgb
        for name, part in self._parts.items():
            handle = self._handles[name]
            handle.batched_wxyzs = poses.wxyz[part.geom].astype(np.float32)
            handle.batched_positions = _positions(part, poses)
            if is_recoloured:
                handle.batched_colors = _bytes(frame.rgb[part.geom])
        tip = np.asarray(frame.p_world_tip)
        self._tips.append(tip)
        self._path.points = _segments(np.stack(self._tips))
        self._plan.points = _segments(np.concatenate([tip[None], frame.plan]))

    def remove(self) -> None:
        """Removes the rollout from the page."""
        self._root.remove()


def aim(server: "viser.ViserServer", rollouts: int) -> None:
    """Points the camera of new pages at all rollouts."""
    others = rollouts - 1
    middle = 0.5 * _SPACING * others
    # One rollout: the board fills a third of the height, and the trocar's handle is below the top.
    server.initial_camera.position = (0.2 + 0.48 * others, middle - 0.16, 0.21 + 0.21 * others)
    server.initial_camera.look_at = (0.0, middle, 0.09)
    server.initial_camera.fov = _FOV
    server.initial_camera.near = 0.005


class GeomPoses(NamedTuple):
    """World poses of all G geoms.

    Attributes:
      p: positions `[G, 3]` in m.
      R: rotations `[G, 3, 3]`.
      wxyz: the same rotations as quaternions `[G, 4]`.
    """

    p: np.ndarray
    R: np.ndarray
    wxyz: np.ndarray


def kinematics(m: mujoco.MjModel) -> Callable[..., GeomPoses]:
    """Makes (qpos `[Q]`, p_world_trocar `[A, 3]` m, bodies at rest or None) -> GeomPoses."""
    data = mujoco.MjData(m)
    bodies = [m.body(b) for b in range(m.nbody)]
    trocars = [int(b.mocapid[0]) for b in bodies if b.mocapid[0] >= 0]

    def poses(qpos: np.ndarray, p_world_trocar: np.ndarray, still: Pose | None = None) -> GeomPoses:
        data.qpos[:], points = thread_geoms.split(m, qpos)
        data.mocap_pos[trocars[: len(p_world_trocar)]] = p_world_trocar
        still_bodies.place(m, data, still)
        mujoco.mj_kinematics(m, data)
        thread_geoms.place(m, data, points)
        wxyz = np.zeros((m.ngeom, 4))
        for g in range(m.ngeom):
            mujoco.mju_mat2Quat(wxyz[g], data.geom_xmat[g])
        return GeomPoses(data.geom_xpos.copy(), data.geom_xmat.reshape(-1, 3, 3).copy(), wxyz)

    return poses


def _add_grid(
    scene: "viser.SceneApi", name: str, size: np.ndarray, p: np.ndarray, wxyz: np.ndarray
) -> None:
    """Adds squares on a plane to show its scale."""
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
        position=p + np.array([0.0, 0.0, _GRID_HEIGHT]),
        wxyz=wxyz,
    )


def _positions(part: meshes.Instances, poses: GeomPoses) -> np.ndarray:
    """Returns the world positions `[K, 3]` of instances in m."""
    offset = np.einsum("kij,kj->ki", poses.R[part.geom], part.offset)
    return (poses.p[part.geom] + offset).astype(np.float32)


def _bytes(rgb: np.ndarray) -> np.ndarray:
    return np.clip(255.0 * _DIM * rgb + 0.5, 0, 255).astype(np.uint8)


def _segments(p: np.ndarray) -> np.ndarray:
    """Splits paths `[T, A, 3]` into segments `[K, 2, 3]`; a single position becomes a point."""
    if len(p) < 2:
        p = np.concatenate([p, p])
    return np.stack([p[:-1], p[1:]], 2).reshape(-1, 2, 3).astype(np.float32)
