"""Names of the entries of columns: order and units in every format."""

import math
import re
from collections.abc import Iterator
from pathlib import Path

from msgspec import structs

from starjax.addons.formats import mapping as maps
from starjax.addons.formats import tip_poses
from starjax.addons.formats.base import Source
from starjax.addons.formats.mapping import ArmColumns, Columns, Map
from starjax.core import errors

_NAMED = re.compile(r"(.+)\[([^\[\]]+)\]")
_AXIS = re.compile(r"(?:^|[^a-z]|q|quat|rot|pos)([wxyz])(?:[^a-z]|mm|cm|m)*$")
_ENDING = re.compile(r"[._ ]?(pos|position|q|angle)$")
_UNIT = re.compile(r"(?:^|[^a-z])(mm|cm|m|millimet\w+|deg|degree|degrees)(?:[^a-z]|$)")


def resolve(mapping: Map, source: Source, folder: Path) -> Map:
    """Returns the mapping with names of entries as indices, and joints in the model's order.

    `joint_states[elbow]` is the entry called so. Entries that carry names of a model's joints are
    taken by them in any order.

    Args:
      folder: of the mapping file, where robots' models lie.

    Raises:
      errors.UsageError: a column or a name is missing.
    """
    mapping = maps.with_columns(mapping, lambda columns: _indexed(columns, source))
    maps.check(mapping, source)
    arms = tuple(_by_joints(arm, source, folder) if arm.joints else arm for arm in mapping.arms)
    return structs.replace(mapping, arms=arms)


def doubts(mapping: Map, source: Source) -> Iterator[str]:
    """Yields notes on columns whose names say another order or unit than the mapping."""
    for i, arm in enumerate(mapping.arms):
        command_as = arm.command_rotation_as or arm.rotation_as
        for columns, kind in ((arm.rotation, arm.rotation_as), (arm.command_rotation, command_as)):
            if isinstance(kind, str) and kind.startswith("quat"):
                yield from _in_order(columns, kind.removeprefix("quat_"), source, i)
        lengths = [arm.position, arm.command_position, arm.trocar]
        for columns in lengths:
            yield from _in_order(columns, "xyz", source, i)
            yield from _in_unit(columns, mapping.units, source, i)
        rotates = arm.rotation if not arm.rotation_as.startswith("quat") else ()
        for columns in (arm.joints, rotates):
            yield from _in_unit(columns, "rad", source, i)


def of(columns: Columns, source: Source) -> list[str]:
    """Returns the names of the entries of columns: those of the column if it has one entry."""
    labels = []
    for text in maps.listed(columns):
        name, low, high = maps.part(text)
        column = source.columns[name]
        size = math.prod(column.shape)
        own = list(column.names) if len(column.names) == size else []
        own = own or ([name] if size == 1 else [f"{name}[{k}]" for k in range(size)])
        labels += own[low:high]
    return labels


def _indexed(columns: Columns, source: Source) -> Columns:
    texts = []
    for text in maps.listed(columns):
        match = _NAMED.fullmatch(text)
        if match and not re.fullmatch(r"[\d:]+", match[2]) and match[1] in source.columns:
            names = source.columns[match[1]].names
            errors.choice(f"--map: entry of {match[1]}", match[2], names)
            text = f"{match[1]}[{names.index(match[2])}]"
        texts.append(text)
    return columns if list(maps.listed(columns)) == texts else tuple(texts)


def _by_joints(arm: ArmColumns, source: Source, folder: Path) -> ArmColumns:
    labels = [_joint(label) for label in of(arm.joints, source)]
    known = {_joint(name): name for name in tip_poses.joint_names(folder / arm.model)}
    wanted = [_joint(name) for name in arm.joint_names]
    labels = _shortened(labels, wanted or list(known))
    if not wanted and set(labels) <= set(known):
        return structs.replace(arm, joint_names=tuple(known[label] for label in labels))
    wanted = wanted or list(known)[: len(labels)]
    shared = set(wanted) & set(labels)
    if not shared or labels == wanted:
        return arm
    for name in wanted:
        errors.choice("--map: joints", name, labels)
    entries = _entries(arm.joints, source)
    return structs.replace(arm, joints=tuple(entries[labels.index(name)] for name in wanted))


def _entries(columns: Columns, source: Source) -> list[str]:
    """Returns columns of one entry each."""
    entries = []
    for text in maps.listed(columns):
        name, low, high = maps.part(text)
        size = math.prod(source.columns[name].shape)
        entries += [f"{name}[{k}]" for k in range(size)[low:high]]
    return entries


def _shortened(labels: list[str], joints: list[str]) -> list[str]:
    """Returns labels without words before a joint's name: `left_yaw` is `yaw`."""
    shortened = []
    for label in labels:
        ends = [name for name in joints if re.search(rf"[^a-z0-9]{re.escape(name)}$", label)]
        shortened.append(label if label in joints else max(ends, key=len, default=label))
    return shortened if len(set(shortened)) == len(labels) else labels


def _joint(name: str) -> str:
    return _ENDING.sub("", name.lower())


def _in_order(columns: Columns, order: str, source: Source, arm: int) -> Iterator[str]:
    labels = of(columns, source)
    axes = [match[1] for label in labels if (match := _AXIS.search(label.lower()))]
    if sorted(axes) == sorted(order) and "".join(axes) != order:
        yield f"arm {arm}: {', '.join(labels)} are read as {', '.join(order)}"


def _in_unit(columns: Columns, unit: str, source: Source, arm: int) -> Iterator[str]:
    for label in of(columns, source):
        if match := _UNIT.search(label.lower()):
            said = (
                match[1][:3] if match[1].startswith("deg") else match[1].replace("millimet", "mm")
            )
            said = "mm" if said.startswith("mm") else said
            if (said != unit and unit != "rad") or said == "deg":
                yield f"arm {arm}: {label} is read in {unit}"
                return
