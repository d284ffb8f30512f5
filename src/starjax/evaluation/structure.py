"""Checks the structure of JSON that was read from a file, and says where it is not as expected.

A kind is a type, a list of one kind, or an object: a kind by name, `?` after the names of what may
be missing or null, or one kind by `*` for every name.
"""

import json
from pathlib import Path
from typing import Any

from starjax import errors

NUMBER = int | float
_WORDS = {
    dict: "an object",
    list: "a list",
    str: "text",
    bool: "true or false",
    int: "a whole number",
    NUMBER: "a number",
}


def check(file: Path, value: Any, kind: Any, place: str = "") -> None:
    """Raises a UsageError that names `file` and the place in it if `value` is not of `kind`."""
    types = type(kind) if isinstance(kind, dict | list) else kind
    if not isinstance(value, types):
        got = "nothing" if value is None else json.dumps(value)[:60]
        where = f"{file}: {place}" if place else str(file)
        raise errors.UsageError(where, _WORDS[types], got)
    if isinstance(kind, list):
        for i, item in enumerate(value):
            check(file, item, kind[0], f"{place}[{i}]")
    if isinstance(kind, dict):
        for name, part in kind.items():
            for key in value if name == "*" else [name.removesuffix("?")]:
                found = value.get(key)
                if found is not None or not name.endswith("?"):
                    check(file, found, part, f"{place}.{key}" if place else key)
