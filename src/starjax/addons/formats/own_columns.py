"""Mapping of an export whose metadata is lost: other tools delete, split and merge episodes.

LeRobot's `lerobot-edit-dataset` keeps the columns `starjax.*` and drops meta/starjax.json. The
mapping reads the columns, so nothing but trials' numbers and seeds is lost.
"""

import re

import msgspec
import numpy as np

from starjax.addons.formats import base
from starjax.addons.formats.base import Source
from starjax.addons.formats.mapping import ArmColumns, CameraColumn, Map, ShaftColumns
from starjax.core import errors
from starjax.sim import registries
from starjax.sim.rollouts import episodes

ABOUT = "an edited export of starjax: its own columns"


def mapping(source: Source) -> Map | None:
    """Returns the mapping of a dataset with our columns, None of another.

    Raises:
      errors.UsageError: the dataset does not name one task that is installed.
    """
    tips, trocar = _own("p"), _ending(source, "trocar")
    if tips not in source.columns or trocar is None:
        return None
    name = source.task.replace(" ", "_")
    if name not in registries.tasks.names():
        known = ", ".join(registries.tasks.names())
        hint = "a --map with task names it"
        raise errors.UsageError("PATH", f"one task of {known}", repr(source.task), hint)
    task = registries.tasks.get(name)
    state, success = _own("state"), _ending(source, "reward") or _ending(source, "rewards")
    arms = int(np.prod(source.columns[tips].shape)) // 3
    has_wrist = _own("shaft_p") in source.columns
    cameras = {camera: _image(source, camera) for camera in task.cameras}
    return Map(
        about=ABOUT,
        task=name,
        arms=tuple(_arm(i, trocar, has_wrist) for i in range(arms)),
        cameras={
            camera: CameraColumn(column=column) for camera, column in cameras.items() if column
        },
        state=state if state in source.columns else (),
        success=success or (),
    )


def _arm(arm: int, trocar: str, has_wrist: bool) -> ArmColumns:
    p, R = (f"[{size * arm}:{size * (arm + 1)}]" for size in (3, 9))
    return ArmColumns(
        position=_own("p") + p,
        rotation=_own("R") + R,
        rotation_as="matrix",
        gripper=f"{_own('gripper')}[{arm}]",
        command_position=_own("command_p") + p,
        command_rotation=_own("command_R") + R,
        command_gripper=f"{_own('command_gripper')}[{arm}]",
        trocar=trocar + p,
        shaft=ShaftColumns(position=_own("shaft_p") + p, rotation=_own("shaft_R") + R)
        if has_wrist
        else msgspec.UNSET,
    )


def _own(field: str) -> str:
    return f"{base.OURS}.{field}"


def _ending(source: Source, word: str) -> str | None:
    """Returns the column whose name ends with a word, however a format calls it."""
    return next((name for name in source.columns if re.split(r"[./]", name)[-1] == word), None)


def _image(source: Source, camera: str) -> str | None:
    names = (_ending(source, word) for word in (camera, f"{episodes.IMAGE}{camera}"))
    return next((name for name in names if name and source.columns[name].is_image), None)
