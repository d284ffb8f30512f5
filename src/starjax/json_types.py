"""Values from JSON against the types of settings. Standard library only."""

import types
import typing
from typing import Any, Literal


def kind(hint: Any) -> str:
    """A field's type, for people."""
    if typing.get_origin(hint) is Literal:
        return f"one of {', '.join(map(str, typing.get_args(hint)))}"
    return getattr(hint, "__name__", str(hint))


def fits(value: Any, hint: Any) -> bool:
    """Whether a value from JSON is of a field's type."""
    origin, kinds = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        return value in kinds
    if origin is tuple:
        return isinstance(value, list | tuple) and all(fits(part, kinds[0]) for part in value)
    if isinstance(hint, types.UnionType):
        return any(fits(value, kind) for kind in kinds)
    if isinstance(value, bool):
        return hint is bool
    return isinstance(value, int | float if hint is float else hint)
