"""The simulated scene of a result, for figures and the video.

MuJoCo itself computes poses from recorded joints, in microseconds; only the pictures of the video
need a compiled program.
"""

import functools
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import mujoco
import numpy as np

from starjax.core.types import ArrayTree, Pose
from starjax.sim import registries, scene, still_bodies, thread_geoms
from starjax.sim.camera import geometry
from starjax.sim.names import SceneNames
from starjax.sim.task import Outline

BATCH = 16  # images per call of the compiled program


class SceneView(NamedTuple):
    """A scene for figures.

    Attributes:
      outline: the task's outline.
      shafts: (qpos `[T, Q]`, p_world_trocar `[A, 3]` m) -> positions of the tips and of the shafts'
        ends in m, the same without a wrist, and directions of the shafts, away from the arm:
        `[T, A, 3]` each.
    """

    outline: Outline
    shafts: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]


def load(names: SceneNames) -> SceneView:
    """Composes a scene.

    Raises:
      errors.UsageError: one of the names is unknown here.
    """
    model = scene.compose(names)
    tools = [registries.tools.get(tool) for tool in names.tools]
    sites = [(scene.tcp(i, tool), f"arm{i}/tool/{tool.base}") for i, tool in enumerate(tools)]

    def shafts(
        qpos: np.ndarray, p_world_trocar: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        rows = [
            [
                np.stack([data.site(tip).xpos, data.site(end).xpos, data.site(end).xmat[2::3]])
                for tip, end in sites
            ]
            for data in _kinematics(model, qpos, p_world_trocar)
        ]
        p, end, axis = np.moveaxis(np.array(rows), 2, 0)
        return p, end, axis

    return SceneView(registries.tasks.get(names.task).outline(model), shafts)


# (qpos `[T, Q]`, p_world_trocar `[A, 3]` m, labels, first, endoscope's Pose `[T]` or None, Pose
# `[K]` of bodies at rest or None) -> `[BATCH, size, size, 3]` uint8 of the steps from `first` on,
# the last one repeated.
Draw = Callable[..., np.ndarray]


class Film(NamedTuple):
    """The program that draws the first camera of a scene.

    Attributes:
      program: (poses, labels) -> `[BATCH, size, size, 3]` uint8.
      model: the scene's C model.
      labels: names of the task's labels.
      camera: the `cameras.SceneCamera`.
      scope: the endoscope, or None if the camera is another one.
    """

    program: Any
    model: mujoco.MjModel
    labels: tuple[str, ...]
    camera: Any
    scope: Any


@functools.lru_cache(maxsize=4)
def _film(names: SceneNames, size: int) -> Film:
    import jax
    import jax.numpy as jnp

    from starjax.runtime import precompile
    from starjax.sim import cameras, endoscope_camera

    # Smooth outlines cost four times as much: seconds on a GPU, minutes on a CPU.
    samples = 1 if jax.default_backend() == "cpu" else 2
    model, task = scene.compose(names), registries.tasks.get(names.task)
    bound, geom_rgb = task.bind(model), geometry.geom_rgb(model)
    scope = endoscope_camera.of(task, names.cameras[:1])
    (view,) = cameras.make(model, names.cameras[:1], size, scope=scope, samples=samples)

    def batch(poses: ArrayTree, labels: dict[str, Any]) -> jax.Array:
        with jax.default_matmul_precision("highest"):  # float32 rays, as in the environment
            rgb = scene.marked(task, bound, labels, jnp.asarray(geom_rgb))
            return jax.lax.map(lambda step: view.draw(*step[:2], rgb, *step[2:]).rgb, poses)

    return Film(precompile.Program(batch), model, tuple(task.labels), view, scope)


def precompile_camera(names: SceneNames, size: int) -> None:
    """Compiles, in the background, the program of `camera` with the same arguments."""
    import jax

    film = _film(names, size)

    def rows(*shape: int) -> Any:
        return jax.ShapeDtypeStruct((BATCH, *shape), np.float32)

    count = film.model.ngeom
    moving = (Pose(rows(3, 3), rows(3)),) if film.camera.moves else ()
    poses = rows(count, 3), rows(count, 3, 3), *moving
    film.program.prepare(poses, dict.fromkeys(film.labels, np.int32(0)))


def camera(names: SceneNames, size: int) -> Draw:
    """Makes the compiled first camera of a scene, for square images of `size` pixels."""
    import jax

    program, model, _, view, scope = _film(names, size)

    def poses(data: mujoco.MjData, held: Pose | None) -> tuple[Any, ...]:
        """Returns positions and rotations of geoms and, if it moves, the camera's pose."""
        geoms = data.geom_xpos.copy(), data.geom_xmat.reshape(-1, 3, 3).copy()
        if not view.moves:
            return geoms
        R_world_body = data.xmat[view.body].reshape(3, 3)
        R, p = (view.R, view.p) if held is None else (held.R, held.p)
        return *geoms, Pose(R_world_body @ R, data.xpos[view.body] + R_world_body @ p)

    def draw(
        qpos: np.ndarray,
        p_world_trocar: np.ndarray,
        labels: dict[str, int],
        first: int,
        endoscope: Pose | None = None,
        still: Pose | None = None,
    ) -> np.ndarray:
        rows = np.minimum(np.arange(first, first + BATCH), len(qpos) - 1)
        held = endoscope if scope else None
        steps = [
            poses(data, None if held is None else Pose(held.R[row], held.p[row]))
            for row, data in zip(rows, _kinematics(model, qpos[rows], p_world_trocar, still))
        ]
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves).astype(np.float32), *steps)
        return np.asarray(program(stacked, {name: np.int32(x) for name, x in labels.items()}))

    return draw


def _kinematics(
    model: mujoco.MjModel, qpos: np.ndarray, p_world_trocar: np.ndarray, still: Pose | None = None
) -> Iterator[mujoco.MjData]:
    """Yields the data at each of the coordinates `[T, Q]`, all else in place."""
    data = mujoco.MjData(model)
    trocars = [model.body(f"trocar{i}").mocapid[0] for i in range(len(p_world_trocar))]
    data.mocap_pos[trocars] = p_world_trocar
    still_bodies.place(model, data, still)
    for row in qpos:
        data.qpos[:], points = thread_geoms.split(model, row)
        mujoco.mj_kinematics(model, data)
        thread_geoms.place(model, data, points)
        yield data
