"""Functions of other packages: an error in one becomes a line with the function and its place."""

import functools
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from starjax.core import errors


def place(function: Callable[..., Any]) -> str:
    """Returns file and line of a function, e.g. `lid.py:33`; empty for an object without code."""
    code = getattr(getattr(function, "__wrapped__", function), "__code__", None)
    return f"{Path(code.co_filename).name}:{code.co_firstlineno}" if code else ""


def subject(part: str, name: str, function: Callable[..., Any]) -> str:
    """Returns the argument of errors, e.g. `task lid: status (lid.py:33)`."""
    where = place(function)
    return f"{part}: {name} ({where})" if where else f"{part}: {name}"


def guarded(part: str, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """Returns a part's function whose exceptions are UsageErrors with its place.

    Args:
      part: kind and name of the part, e.g. `task lid`.
      name: of the function in the part's record.
    """

    @functools.wraps(function)
    def wrapped(*args: Any, **options: Any) -> Any:
        try:
            return function(*args, **options)
        except errors.UsageError:
            raise
        except Exception as error:
            got = f"{type(error).__name__}: {_first_line(error)}{_line_in(function, error)}"
            raise errors.UsageError(subject(part, name, function), "a result", got) from error

    return wrapped


def _first_line(error: Exception) -> str:
    return next((line for line in str(error).splitlines() if line.strip()), "")


def _line_in(function: Callable[..., Any], error: Exception) -> str:
    """Returns the innermost line of an error in the function's file, e.g. ` in lid.py:40`."""
    code = getattr(function, "__code__", None)
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if code and frame.filename == code.co_filename]
    return f" in {Path(code.co_filename).name}:{lines[-1]}" if code and lines else ""
