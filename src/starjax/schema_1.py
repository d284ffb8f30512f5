"""Names that files of schema 1 take for granted. Standard library only.

They were written when there was one scene with one arm, whose task had two labels and its expert
one switch.
"""

from collections.abc import Mapping
from typing import Any

SCENE = ("peg_transfer", ("fr5",), ("grasper",), ("camera",))  # task, arms, tools, cameras
_LABELS = ("source", "target")  # fields of a trial
_RECORDED_LABEL = "{}_peg"  # an array of recorded trials
_SWITCH = "one_wall"  # of the expert, today a variant of this name


def labels(trial: Mapping[str, Any]) -> dict[str, Any]:
    """The task's labels among the fields of a trial."""
    return {name: trial[name] for name in _LABELS if name in trial}


def recorded_labels(arrays: Mapping[str, Any]) -> dict[str, Any]:
    """The task's labels among the arrays of recorded trials."""
    found = {name: arrays.get(_RECORDED_LABEL.format(name)) for name in _LABELS}
    return {name: array for name, array in found.items() if array is not None}


def has_switch(demos: Mapping[str, Any]) -> bool:
    """Whether settings of demonstrations say in schema 1's way which expert it was."""
    return _SWITCH in demos


def with_expert(demos: Mapping[str, Any], usual: str) -> dict[str, Any]:
    """Settings of demonstrations that name the expert, `usual` where the switch was off."""
    rest = {name: value for name, value in demos.items() if name != _SWITCH}
    return {"expert": _SWITCH if demos.get(_SWITCH) else usual} | rest
