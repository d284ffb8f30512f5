"""Command lines for frozen dataclasses: tyro parses and prints the help, mistakes are one line.

tyro's own error is a box of five lines; here a mistake is found first and said in one: the
argument, what was expected, what came. Imports neither jax nor numpy.
"""

import dataclasses
import difflib
import itertools
import shlex
import types
import typing
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, Literal, TypeVar

import tyro

from starjax import config as config_lib

SettingsT = TypeVar("SettingsT")

# The words before the flags, as help names them.
Run = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
RunOrNone = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="[RUN]")]
Runs = Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN [RUN ...]")]


def parse(
    settings: type[SettingsT],
    argv: Sequence[str],
    *,
    prog: str,
    description: str,
    default: SettingsT | None = None,
) -> SettingsT:
    """Returns `settings` filled from `argv`; missing fields come from `default`.

    Raises:
      config.UsageError: one line that names the argument, what was expected and what came.
    """
    if not {"-h", "--help"} & set(argv):
        _check(flags(settings), argv[_count_positional(settings, argv) :])
    start = tyro.MISSING_NONPROP if default is None else default
    return tyro.cli(settings, args=list(argv), prog=prog, description=description, default=start)


def flags(settings: type, prefix: str = "") -> dict[str, Any]:
    """Every flag of a (nested) dataclass, e.g. `--train.steps`, with the type of its value."""
    found: dict[str, Any] = {}
    hints = typing.get_type_hints(settings)
    for field in dataclasses.fields(settings):
        hint, name = hints[field.name], prefix + field.name.replace("_", "-")
        if dataclasses.is_dataclass(hint) and isinstance(hint, type):
            found |= flags(hint, f"{name}.")
        elif _is_positional(settings, field.name):
            continue
        elif hint is bool:
            found |= {f"--{name}": None, f"--{prefix}no-{field.name.replace('_', '-')}": None}
        else:
            found[f"--{name}"] = hint
    return found


def value_of(flag: str, argv: Sequence[str]) -> str | None:
    """The word after the last `flag` (or its `flag=word`), None if the flag is not there."""
    found = None
    for token, following in itertools.zip_longest(argv, argv[1:]):
        name, equals, word = token.partition("=")
        if _spelled(name) == flag:
            found = word if equals else following or found
    return found


def is_given(flag: str, argv: Sequence[str]) -> bool:
    """Whether `flag` was typed, with hyphens or with underscores."""
    return flag in (_spelled(token.partition("=")[0]) for token in argv)


def typed(name: str, argv: Sequence[str]) -> str:
    """The command line, for the record in result.json."""
    return shlex.join(["starjax", name, *argv])


def suggest(word: str, known: Iterable[str]) -> str:
    """`; did you mean ...?` for the nearest known word, else nothing."""
    near = difflib.get_close_matches(word, list(known), n=1, cutoff=0.6)
    return f"; did you mean {near[0]}?" if near else ""


def choice(argument: str, value: str, known: Iterable[str]) -> None:
    """Raises UsageError unless `value` is one of `known`."""
    names = list(known)
    if value not in names:
        raise config_lib.UsageError(
            f"{argument}: expected one of {', '.join(names)}, got {value!r}{suggest(value, names)}"
        )


def _spelled(token: str) -> str:
    """A flag as `flags` spells it: tyro takes underscores for hyphens."""
    return token.replace("_", "-") if token.startswith("--") else token


def _is_positional(settings: type, name: str) -> bool:
    hint = typing.get_type_hints(settings, include_extras=True)[name]
    return tyro.conf.Positional in getattr(hint, "__metadata__", ())


def _count_positional(settings: type, argv: Sequence[str]) -> int:
    """Words before the first flag; UsageError unless they are as many as `settings` asks for."""
    given = next((i for i, token in enumerate(argv) if token.startswith("-")), len(argv))
    hints = typing.get_type_hints(settings)
    fields = [f for f in dataclasses.fields(settings) if _is_positional(settings, f.name)]
    names = [field.name for field in fields]
    needed = sum(field.default is dataclasses.MISSING for field in fields)
    several = any(typing.get_origin(hints[name]) is tuple for name in names)
    if names and (given < needed or (given > len(names) and not several)):
        got = " ".join(argv[:given]) or "none"
        raise config_lib.UsageError(
            f"{' '.join(names).upper()}: expected before any flag, got {got}"
        )
    return given if names else 0


def _check(known: Mapping[str, Any], argv: Sequence[str]) -> None:
    """Finds the first mistake in `argv`."""
    index = 0
    while index < len(argv):
        token, equals, value = argv[index].partition("=")
        index += 1
        if not token.startswith("--"):
            raise config_lib.UsageError(f"{token}: expected a flag such as {next(iter(known))}")
        flag = _spelled(token)
        if flag not in known:
            raise config_lib.UsageError(f"{token}: unknown argument{suggest(flag, known)}")
        values = [value] if equals else []
        while not equals and index < len(argv) and not argv[index].startswith("--"):
            values.append(argv[index])
            index += 1
        _check_values(flag, known[flag], values)


def _check_values(flag: str, hint: Any, values: list[str]) -> None:
    """Checks the words after one flag against its type."""
    several = typing.get_origin(hint) is tuple
    if hint is None:
        expected = 0
    elif several and Ellipsis not in typing.get_args(hint):
        expected = len(typing.get_args(hint))
    else:
        expected = max(1, len(values)) if several else 1
    if len(values) != expected:
        got = " ".join(values) or "none"
        raise config_lib.UsageError(f"{flag}: expected {expected} value(s), got {got}")
    for value in values:
        _check_value(flag, typing.get_args(hint)[0] if several else hint, value)


def _check_value(flag: str, hint: Any, value: str) -> None:
    """Checks one word against `int`, `float`, a `Literal`; any word is a string or a path."""
    if isinstance(hint, types.UnionType):  # `float | None`: a value, unless nothing was typed
        hint = typing.get_args(hint)[0]
    if typing.get_origin(hint) is Literal:
        choice(flag, value, [str(arg) for arg in typing.get_args(hint)])
    if hint in (int, float):
        try:
            hint(value)
        except ValueError:
            kind = "a whole number" if hint is int else "a number"
            raise config_lib.UsageError(f"{flag}: expected {kind}, got {value!r}") from None
