"""A sweep's trials in the scene: dots at their trocars above a floor of the local success rate."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from starjax import rcm
from starjax.evaluation import rate_map, result
from starjax.rcm.trocar import Trocar
from starjax.sim import registries

if TYPE_CHECKING:  # for annotations alone
    import viser

_SUCCESS_RGB, _FAILURE_RGB = (0, 121, 107), (194, 97, 31)
_SIZE = 0.0016  # m
_PIXEL = 0.0005  # m
_PALE, _STRONG = 80, 230  # opacity of the floor at full success and at none, of 255
_HEIGHT = 0.001  # m above the task's own floor
LEGEND = "Dots: trocars of the sweep; teal succeeded, orange failed. Floor: rate of success nearby"


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


def floor(shown: SuccessMap) -> tuple[np.ndarray, np.ndarray]:
    """Draws the rate of success around each place, failures more strongly.

    Returns:
      `[h, w, 4]` uint8 RGBA, transparent far from all trials, columns along x and rows along y, and
      bounds `[2, 2]` m: least and greatest x, y.
    """
    arms = shown.p_world_trocar.shape[1]
    trials = shown.p_world_trocar[..., :2].reshape(-1, 2)
    edge = rate_map.FAR * rate_map.WIDTH
    bounds = np.stack([trials.min(0) - edge, trials.max(0) + edge])
    x, y = (np.arange(low, high, _PIXEL) for low, high in bounds.T)
    success = np.repeat(shown.success, arms).astype(float)
    rate = rate_map.around(x, y, trials, success, np.ones(len(trials)))
    mean = np.nan_to_num(rate)[..., None]
    rgb = mean * np.array(_SUCCESS_RGB) + (1 - mean) * np.array(_FAILURE_RGB)
    opacity = np.isfinite(rate)[..., None] * (mean * _PALE + (1 - mean) * _STRONG)
    return np.dstack([rgb, opacity]).round().astype(np.uint8), bounds


def add(scene: "viser.SceneApi", shown: SuccessMap) -> list[Any]:
    """Adds dots and floor to the scene; returns their handles."""
    arms = shown.p_world_trocar.shape[1]
    colours = np.where(shown.success[:, None], _SUCCESS_RGB, _FAILURE_RGB).astype(np.uint8)
    dots = scene.add_point_cloud(
        "/sweep/trocars",
        shown.p_world_trocar.reshape(-1, 3).astype(np.float32),
        np.repeat(colours, arms, axis=0),
        point_size=_SIZE,
        point_shape="circle",
        precision="float32",
    )
    image, bounds = floor(shown)
    width, depth = bounds[1] - bounds[0]
    height = registries.tasks.get(shown.task).floor + _HEIGHT
    drawn = scene.add_image(
        "/sweep/floor",
        image,
        float(width),
        float(depth),
        cast_shadow=False,
        receive_shadow=False,
        position=(*bounds.mean(0).tolist(), height),
    )
    return [dots, drawn]
