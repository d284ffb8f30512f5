"""Command lines for frozen dataclasses: tyro parses and prints the help, mistakes are one line.

tyro's own error is a box of five lines; here a mistake is found first and said in one: the
argument, what was expected, what came. Imports neither jax nor numpy.
"""

import dataclasses
import itertools
import re
import shlex
import types
import typing
from collections.abc import Sequence
from typing import Annotated, Any, Literal, TypeVar

import tyro

from starjax import config as config_lib
from starjax import errors

SettingsT = TypeVar("SettingsT")

_FIELD = re.compile(r"[a-z][a-z0-9_.]*")

# The words before the flags, as help names them.
Run = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
RunOrNone = Annotated[
    str, tyro.conf.Positional, tyro.conf.arg(metavar="[RUN]", help_behavior_hint="")
]
Runs = Annotated[
    tuple[str, ...],
    tyro.conf.Positional,
    tyro.conf.arg(metavar="RUN [RUN ...]", help_behavior_hint="(required)"),
]
# Of a flag whose default is said in words.
in_words = tyro.conf.arg(help_behavior_hint="")
FloatOrNone = Annotated[float | None, tyro.conf.arg(metavar="FLOAT", help_behavior_hint="")]


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
      errors.UsageError: one line that names the argument, what was expected and what came.
    """
    if not {"-h", "--help"} & set(argv):
        argv = _sorted(settings, argv)
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


def spelled(error: errors.UsageError) -> str:
    """A mistake's line, with flags instead of the fields that library code names."""
    line = str(error)
    if _FIELD.fullmatch(error.argument):
        line = line.replace(error.argument, _flag(error.argument), 1)
    # Elsewhere in it a field without a dot would be an ordinary word.
    fields = [_field(flag) for flag in flags(config_lib.RunConfig) if "." in flag]
    known = rf"(?<![\w./-])({'|'.join(map(re.escape, fields))})\b"
    return re.sub(known, lambda found: _flag(found[0]), line)


def _flag(field: str) -> str:
    return f"--{field.replace('_', '-')}"


def _field(flag: str) -> str:
    return flag[2:].replace("-", "_")


def _spelled(token: str) -> str:
    """A flag as `flags` spells it: tyro takes underscores for hyphens."""
    return token.replace("_", "-") if token.startswith("--") else token


def _is_positional(settings: type, name: str) -> bool:
    hint = typing.get_type_hints(settings, include_extras=True)[name]
    return tyro.conf.Positional in getattr(hint, "__metadata__", ())


def _sorted(settings: type, argv: Sequence[str]) -> list[str]:
    """`argv` without a mistake: the words of no flag first, then the flags with theirs."""
    known = flags(settings)
    fields = [f for f in dataclasses.fields(settings) if _is_positional(settings, f.name)]
    words, rest, index = [], [], 0
    while index < len(argv):
        token, equals, value = argv[index].partition("=")
        if fields and not token.startswith("-"):
            words.append(argv[index])
            index += 1
            continue
        if not token.startswith("--"):
            raise errors.UsageError("FLAG", f"one such as {next(iter(known))}", token)
        flag, end = _spelled(token), index + 1
        if flag not in known:
            raise errors.UsageError("FLAG", "one of --help", token, errors.nearest(flag, known))
        while not equals and end < len(argv) and not argv[end].startswith("--"):
            end += 1
        values = [value] if equals else list(argv[index + 1 : end])
        count = _count(known[flag], values)
        if fields and not equals and len(values) > count:  # what follows is of no flag
            values, end = values[:count], index + 1 + count
        _check_values(flag, known[flag], values, count)
        rest += argv[index:end]
        index = end
    _check_words(settings, fields, words)
    return [*words, *rest]


def _check_words(settings: type, fields: Sequence[dataclasses.Field], words: list[str]) -> None:
    """UsageError unless there are as many words of no flag as positional fields ask for."""
    needed = sum(field.default is dataclasses.MISSING for field in fields)
    hints = typing.get_type_hints(settings)
    several = any(typing.get_origin(hints[field.name]) is tuple for field in fields)
    if len(words) < needed or (len(words) > len(fields) and not several):
        names, got = " ".join(field.name for field in fields).upper(), " ".join(words) or "none"
        count = "one or more" if several else len(fields)
        raise errors.UsageError(names, str(count), got)


def _count(hint: Any, values: Sequence[str]) -> int:
    """How many words a flag of this type takes."""
    if hint is None:
        return 0
    if typing.get_origin(hint) is not tuple:
        return 1
    kinds = typing.get_args(hint)
    return max(1, len(values)) if Ellipsis in kinds else len(kinds)


def _check_values(flag: str, hint: Any, values: Sequence[str], count: int) -> None:
    """Checks the words after one flag, of which it takes `count`, against its type."""
    if len(values) != count:
        raise errors.UsageError(flag, f"{count} value(s)", " ".join(values) or "none")
    several = typing.get_origin(hint) is tuple
    for value in values:
        _check_value(flag, typing.get_args(hint)[0] if several else hint, value)


def _check_value(flag: str, hint: Any, value: str) -> None:
    """Checks one word against `int`, `float`, a `Literal`; any word is a string or a path."""
    if isinstance(hint, types.UnionType):  # `float | None`: a value, unless nothing was typed
        hint = typing.get_args(hint)[0]
    if typing.get_origin(hint) is Literal:
        errors.choice(flag, value, [str(arg) for arg in typing.get_args(hint)])
    if hint in (int, float):
        try:
            hint(value)
        except ValueError:
            kind = "a whole number" if hint is int else "a number"
            raise errors.UsageError(flag, kind, repr(value)) from None
