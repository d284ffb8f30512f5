"""The simulated scene of a result, set up again for figures and the video."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from starjax.sim.names import SceneNames
from starjax.sim.tasks.base import Outline
from starjax.types import Pose

BATCH = 16  # images drawn in one call


class SceneView(NamedTuple):
    """A scene, as figures draw it.

    Attributes:
      outline: of the task.
      tips: (qpos `[T, Q]`, p_world_trocar `[A, 3]` m) -> positions of the tips in m, and the
        directions of their shafts, away from the arm: `[T, A, 3]` each.
    """

    outline: Outline
    tips: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def load(names: SceneNames) -> SceneView:
    """Composes the scene of these names; nothing is compiled for a device.

    Raises:
      errors.UsageError: one of the names is unknown here.
    """
    import mujoco

    from starjax.sim import registries, scene

    model = scene.compose(names)
    marks = [model.body(f"trocar{i}").mocapid[0] for i in range(len(names.arms))]
    sites = [scene.tcp(i, registries.tools.get(tool)) for i, tool in enumerate(names.tools)]

    def tips(qpos: np.ndarray, p_world_trocar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        data, found = mujoco.MjData(model), []
        data.mocap_pos[marks] = p_world_trocar
        for data.qpos[:] in qpos:
            mujoco.mj_kinematics(model, data)
            found.append([np.stack([data.site(s).xpos, data.site(s).xmat[2::3]]) for s in sites])
        p, axis = np.moveaxis(np.array(found), 2, 0)
        return p, axis

    return SceneView(registries.tasks.get(names.task).outline(model), tips)


# (qpos `[T, Q]`, p_world_trocar `[A, 3]` m, labels, first, endoscope's Pose `[T]` or None) ->
# `[BATCH, size, size, 3]` uint8 of the steps from `first` on, the last one repeated.
Draw = Callable[..., np.ndarray]


def camera(names: SceneNames, size: int) -> Draw:
    """Compiles the first camera of a scene, for square images of `size` pixels a side."""
    import jax
    import jax.numpy as jnp

    from starjax.sim import cameras, endoscope_camera, physics, render, scene

    # Smooth outlines cost four times as much: a matter of seconds on a GPU, of minutes on a CPU.
    samples = 1 if jax.default_backend() == "cpu" else 2
    made = scene.load(names)
    scope = endoscope_camera.of(made.task, names.cameras[:1])
    (shown,) = cameras.make(made.mj_model, names.cameras[:1], size, scope=scope)
    smooth = {"samples": samples, "moves": shown.moves}
    shown = shown._replace(draw=render.make(made.mj_model, shown.name, size, size, **smooth))
    still = cameras.nominal([shown])

    def one(qpos: jax.Array, held: Any, p_world_trocar: jax.Array, rgb: jax.Array) -> jax.Array:
        data = physics.kinematics(made, qpos, p_world_trocar)
        poses = still if held is None else jax.tree.map(lambda leaf: leaf[None], held)
        return cameras.images([shown], poses, data, rgb)[shown.name].rgb

    @jax.jit
    def batch(
        qpos: jax.Array, held: Any, p_world_trocar: jax.Array, labels: dict[str, Any]
    ) -> jax.Array:
        rgb = scene.marked(made.task, made.bound, labels, jnp.asarray(made.geom_rgb))
        return jax.lax.map(lambda step: one(step[0], step[1], p_world_trocar, rgb), (qpos, held))

    def draw(
        qpos: np.ndarray,
        p_world_trocar: np.ndarray,
        labels: dict[str, int],
        first: int,
        held: Pose | None = None,
    ) -> np.ndarray:
        rows = np.minimum(np.arange(first, first + BATCH), len(qpos) - 1)
        marked = {name: np.int32(value) for name, value in labels.items()}
        held = held if scope else None
        qpos, held = jax.tree.map(lambda leaf: leaf[rows].astype(np.float32), (qpos, held))
        with jax.default_matmul_precision("highest"):  # poses to float32, as the environment's
            return np.asarray(batch(qpos, held, p_world_trocar.astype(np.float32), marked))

    return draw
