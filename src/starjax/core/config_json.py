"""JSON form of settings, and the settings that determine weights. Imports no jax.

Files of runs and policies hold this form; a learner's options are on the level of the policy's.
"""

import dataclasses
import json
import typing
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec

from starjax.core.config import PolicyConfig, RunConfig
from starjax.core.learners import LEARNERS
from starjax.core.limits import INLINE

if TYPE_CHECKING:  # for annotations alone
    from _typeshed import DataclassInstance

SettingsT = TypeVar("SettingsT")

# Sections that determine a policy's weights; others may change when a run resumes.
_WEIGHT_SECTIONS = ("seed", "scene", "demos", "policy", "train")
_NOT_OF_WEIGHTS = {"train.keep_checkpoints", "train.checkpoint_every", "train.steps_per_call"}


def weight_settings(config: RunConfig) -> dict[str, Any]:
    """Returns the settings that determine a policy's weights: name -> JSON value."""
    values = as_json(config)
    flat = _flat({name: values[name] for name in _WEIGHT_SECTIONS})
    return {name: value for name, value in flat.items() if name not in _NOT_OF_WEIGHTS}


def differing_settings(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Returns the names of settings in which the weights of several runs differ, except the seed.

    `configs` are JSON values. Missing settings have their default.
    """
    default = as_json(RunConfig())
    parts = [part for part in _WEIGHT_SECTIONS if part != "seed"]
    filled = [{part: default[part] | old.get(part, {}) for part in parts} for old in configs]
    rows = [_flat(values) for values in filled]
    return [
        name
        for name in dict.fromkeys(name for row in rows for name in row)
        if name not in _NOT_OF_WEIGHTS and any(row.get(name) != rows[0].get(name) for row in rows)
    ]


def as_json(settings: "DataclassInstance") -> dict[str, Any]:
    """Returns settings as JSON values: dicts, and lists for tuples."""
    return json.loads(json.dumps(_plain(settings)))


def _plain(settings: Any) -> dict[str, Any]:
    values = {}
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if not dataclasses.is_dataclass(value):
            values[field.name] = value
        elif field.metadata == INLINE:
            values |= _plain(value)
        else:
            values[field.name] = _plain(value)
    return values


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Returns nested values as one level with names such as `train.steps`."""
    flat = {}
    for name, value in values.items():
        is_nested = isinstance(value, dict)
        flat |= _flat(value, f"{prefix}{name}.") if is_nested else {f"{prefix}{name}": value}
    return flat


def from_dict(settings: type[SettingsT], values: Mapping[str, Any]) -> SettingsT:
    """Returns settings from JSON values; missing fields keep their default.

    Raises:
      ValueError: a name is unknown, or a value has the wrong type.
    """
    if not isinstance(values, Mapping):
        raise ValueError(f"{settings.__name__}: expected an object, got {values!r}")
    hints = typing.get_type_hints(settings)
    if settings is PolicyConfig:
        values = _nested(values)
        hints["options"] = type(values["options"])
    unknown = sorted(set(values) - set(hints))
    if unknown:
        raise ValueError(f"{settings.__name__}: expected {sorted(hints)}, got {unknown}")
    fields = {}
    for name, value in values.items():
        if dataclasses.is_dataclass(value):
            fields[name] = value
        elif dataclasses.is_dataclass(hints[name]):
            fields[name] = from_dict(hints[name], value)
        else:
            try:
                fields[name] = msgspec.convert(value, hints[name])
            except msgspec.ValidationError as error:
                raise ValueError(f"{settings.__name__}.{name}: {error}") from error
    return settings(**fields)


def _nested(policy: Mapping[str, Any]) -> dict[str, Any]:
    """Returns a policy's settings with the learner's options in a part of their own."""
    learner = policy.get("learner", PolicyConfig.learner)
    if not isinstance(learner, str):
        raise ValueError(f"PolicyConfig.learner: expected str, got {learner!r}")
    settings = LEARNERS.get(learner).settings
    shared = {field.name for field in dataclasses.fields(PolicyConfig)} - {"options"}
    options = {name: value for name, value in policy.items() if name not in shared}
    rest = {name: value for name, value in policy.items() if name in shared}
    return {**rest, "options": from_dict(settings, options)}
