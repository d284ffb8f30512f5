"""A sweep's trials in the scene: a dot at every trocar, in the colour of the outcome."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from starjax import rcm
from starjax.evaluation import result
from starjax.rcm.trocar import Trocar
from starjax.sim import registries

_SUCCESS_RGB, _FAILURE_RGB = (0, 121, 107), (194, 97, 31)
_SIZE = 0.0016  # m
LEGEND = "Dots: trocars of the sweep; teal succeeded, orange failed"


class SuccessMap(NamedTuple):
    """Trials of a sweep.

    Attributes:
      task: name of the task.
      p_world_trocar: `[N, A, 3]` m.
      success: `[N]` strict success.
    """

    task: str
    p_world_trocar: np.ndarray
    success: np.ndarray


def read(file: Path) -> SuccessMap:
    """Reads a sweep.json.

    Raises:
      FileNotFoundError: the file is missing.
      ValueError: it is damaged, or no sweep.
    """
    swept = result.read_sweep(file)
    task = registries.tasks.get(swept.scene.task)
    fields = zip(*((trial.radius, trial.polar, trial.azimuth) for trial in swept.trials))
    trocars = Trocar(*(np.array(field, np.float32) for field in fields))
    p_world_ref = np.array([slot.p_world_ref for slot in task.slots], np.float32)
    p = np.asarray(rcm.trocar_position(trocars, p_world_ref))
    return SuccessMap(task.name, p, np.array([trial.success for trial in swept.trials]))


def add(scene: Any, shown: SuccessMap) -> Any:
    """Adds the dots to the scene; returns their handle."""
    arms = shown.p_world_trocar.shape[1]
    colours = np.where(shown.success[:, None], _SUCCESS_RGB, _FAILURE_RGB).astype(np.uint8)
    return scene.add_point_cloud(
        "/sweep",
        shown.p_world_trocar.reshape(-1, 3).astype(np.float32),
        np.repeat(colours, arms, axis=0),
        point_size=_SIZE,
        point_shape="circle",
        precision="float32",
    )
