"""Recorded episodes as frames: those of a dataset, with the pictures that were recorded."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np

from starjax import errors, rcm
from starjax.data import schema, store
from starjax.rollouts import episodes
from starjax.sim import registries, scene
from starjax.sim.camera import geometry
from starjax.sim.names import SceneNames
from starjax.viewer.frame import Frame


class Dataset(NamedTuple):
    """A folder of demonstrations.

    Attributes:
      root: it. description: as schema 2 says it.
      names: of the scene. model: the C model of it.
      keys: of the episodes that have arrays, in order.
    """

    root: Path
    description: dict[str, Any]
    names: SceneNames
    model: mujoco.MjModel
    keys: Sequence[str]


class Recording(NamedTuple):
    """One episode.

    Attributes:
      frames: of its control steps.
      images: `[T, h, w, 3]` uint8 of the first camera, or None.
      outcome: e.g. `success`.
    """

    frames: list[Frame]
    images: np.ndarray | None
    outcome: str


def opened(root: Path) -> Dataset:
    """Reads what a dataset is.

    Raises:
      errors.UsageError: there is none, it has no episode, or a part of its scene is unknown here.
    """
    description = schema.upgraded(store.read_description(root))
    said = description["scene"]
    names = SceneNames(said["task"], *(tuple(said[part]) for part in ("arms", "tools", "cameras")))
    found = [key for key in store.keys(root) if store.verify(root, key, arrays=False)["files"]]
    if not found:
        raise errors.UsageError("--dataset", "a folder with episodes", root)
    errors.choice("task of the dataset", names.task, registries.tasks.names())
    return Dataset(root, description, names, scene.compose(names), found)


def read(dataset: Dataset, key: str) -> Recording:
    """Reads an episode, after checking every byte of it.

    Raises:
      store.DamagedEpisode: naming the file.
    """
    record = store.verify(dataset.root, key)
    version, folder = dataset.description["schema"], dataset.root / "episodes" / key

    def field(name: str) -> np.ndarray:
        array = np.load(folder / schema.file_name(version, name), allow_pickle=False)
        return schema.with_arms(version, name, array)

    p_world_trocar = rcm.trocar_position(
        schema.trocars_of([record]), np.array(dataset.description["p_world_ref"], np.float32)
    )
    shown = frames(
        field("qpos"),
        np.asarray(p_world_trocar)[0],
        field("p"),
        field("rcm_error"),
        colours(dataset.names, dataset.model, record["labels"]),
    )
    camera = f"{episodes.IMAGE}{dataset.names.cameras[0]}"
    there = schema.file_name(version, camera) in record["files"]
    last = shown[-1]._replace(done=True, success=record["success"], invalid=record["invalid"])
    outcome = "success" if record["success"] else "failed"
    return Recording([*shown[:-1], last], field(camera) if there else None, outcome)


def colours(names: SceneNames, model: mujoco.MjModel, labels: Mapping[str, int]) -> np.ndarray:
    """`[G, 3]` of a scene, the goal of an episode marked."""
    task, rgb = registries.tasks.get(names.task), jnp.asarray(geometry.geom_rgb(model))
    return np.asarray(scene.marked(task, task.bind(model), labels, rgb))


def frames(
    qpos: np.ndarray,
    p_world_trocar: np.ndarray,
    p_world_tip: np.ndarray,
    rcm_error: np.ndarray | None,
    rgb: np.ndarray,
) -> list[Frame]:
    """Frames of T moments.

    Args:
      qpos: `[T, Q]`. p_world_trocar: `[A, 3]` m. p_world_tip: `[T, A, 3]` m.
      rcm_error: `[T, A]` m, zeros where it is not known.
      rgb: `[G, 3]` in [0, 1].
    """
    error = np.zeros(p_world_tip.shape[:2]) if rcm_error is None else rcm_error
    plan = np.zeros((0, *p_world_tip.shape[1:]))
    return [
        Frame(t, qpos[t], p_world_trocar, tip, error[t], rgb, plan, 0, 0.0, *[False] * 4)
        for t, tip in enumerate(p_world_tip)
    ]
