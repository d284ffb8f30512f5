"""Errors of users as three fields and one line. Imports the standard library only."""

import difflib
from collections.abc import Iterable
from typing import Any

_LETTERS = 2  # for a word that can stand for those that contain it
_SUGGESTIONS = 3  # at most


class UsageError(ValueError):
    """An error of the user of a command or function, shown as one line.

    Attributes:
      argument: name of the flag, field or array.
      expected: allowed values, a noun phrase.
      got: value of the user.
      hint: suggested fix, may be empty.
    """

    def __init__(self, argument: str, expected: str, got: Any, hint: str = "") -> None:
        got = got.got if isinstance(got, UsageError) else got  # that of the inner error
        self.argument, self.expected, self.got, self.hint = argument, expected, got, hint
        ending = f"; {hint}" if hint else ""
        super().__init__(f"{argument}: expected {expected}, got {got}{ending}")

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickles its fields: a worker's error reaches the process that waits for it."""
        return type(self), (self.argument, self.expected, str(self.got), self.hint)


def printable(text: str) -> str:
    """Replaces control characters other than line ends by their escapes.

    Texts of foreign files and servers could otherwise move the cursor or change the clipboard.
    """
    return "".join(
        c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text
    )


def choice(argument: str, value: str, known: Iterable[str]) -> None:
    """Raises UsageError unless `value` is one of `known`; suggests the nearest one."""
    names = list(known)
    if value not in names:
        raise UsageError(argument, f"one of {', '.join(names)}", repr(value), nearest(value, names))


def nearest(word: str, known: Iterable[str]) -> str:
    """Returns `did you mean ...?` with the nearest known word, empty if all are far.

    A word that others begin with or contain, such as `peg`, is near to all of them.
    """
    names, low = list(known), word.lower()
    near = difflib.get_close_matches(low, names, n=1, cutoff=0.6)
    if not near and len(low) >= _LETTERS:
        near = [name for name in names if name.startswith(low)]
        near = near or [name for name in names if low in name.lower()]
    return f"did you mean {' or '.join(near[:_SUGGESTIONS])}?" if near else ""
