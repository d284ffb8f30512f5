"""Structures of pytrees as JSON: containers, named tuples and flax's dataclasses."""

import dataclasses
import functools
import importlib
from typing import Any

import jax

_CONSTANTS = (type(None), bool, int, float, str)


def encode(structure: jax.tree_util.PyTreeDef) -> Any:
    """Returns a `PyTreeDef` as a JSON value.

    Raises:
      TypeError: it has a node of another type, or one whose constants are no JSON.
    """
    value = _encode(jax.tree.unflatten(structure, range(structure.num_leaves)))
    if jax.tree.structure(_decode(value)) != structure:
        raise TypeError(f"a structure that JSON does not keep: {structure!r:.80}")
    return value


def decode(value: Any) -> Any:
    """Returns the `PyTreeDef` of `encode`; any error may mean another value."""
    return jax.tree.structure(_decode(value))


def _encode(x: Any) -> Any:
    kind = type(x)
    if x is None or kind is int:  # a leaf's number
        return x
    if kind in (tuple, list):
        return {kind.__name__: [_encode(part) for part in x]}
    if kind is dict and all(type(name) is str for name in x):
        return {"dict": {name: _encode(part) for name, part in x.items()}}
    path = f"{kind.__module__}:{kind.__qualname__}"
    if isinstance(x, tuple) and hasattr(x, "_fields"):
        return {path: [_encode(part) for part in x]}
    if not hasattr(kind, "_flax_dataclass"):
        raise TypeError(f"a pytree's node of type {path}")
    fields = {name: getattr(x, name) for name in _fields(kind)}
    for name, is_node in _fields(kind).items():
        if is_node:
            fields[name] = _encode(fields[name])
        elif type(fields[name]) not in _CONSTANTS:
            raise TypeError(f"{path}.{name}: a constant of type {type(fields[name]).__name__}")
    return {path: fields}


def _decode(value: Any) -> Any:
    if not isinstance(value, dict):
        return value
    ((path, parts),) = value.items()
    if path in ("tuple", "list"):
        return (tuple if path == "tuple" else list)(map(_decode, parts))
    if path == "dict":
        return {name: _decode(part) for name, part in parts.items()}
    module, _, name = path.partition(":")
    kind: Any = functools.reduce(getattr, name.split("."), importlib.import_module(module))
    if isinstance(parts, list):
        return kind(*map(_decode, parts))
    is_node = _fields(kind)
    return kind(**{name: _decode(x) if is_node[name] else x for name, x in parts.items()})


def _fields(kind: type) -> dict[str, bool]:
    """Returns whether each field of a flax dataclass is a node of the tree, not a constant."""
    return {f.name: f.metadata.get("pytree_node", True) for f in dataclasses.fields(kind)}
