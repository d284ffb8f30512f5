"""Command lines for frozen dataclasses: tyro parses and prints the help, mistakes are one line.

Imports neither jax nor numpy.
"""

import dataclasses
import functools
import re
import shlex
import typing
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, NoReturn, TypeVar

import tyro
from tyro import _errors as tyro_errors  # private: see _refuse

from starjax import config as config_lib
from starjax import errors, limits

SettingsT = TypeVar("SettingsT")

AUTO = "auto"  # default of flags whose help explains it
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
FloatOrNone = Annotated[float | None, tyro.conf.arg(metavar="FLOAT")]

_ALIASES = {(config_lib.SceneConfig, "camera"): ("--cameras",)}


@dataclasses.dataclass(frozen=True)
class NoFlags:
    """Settings of a command without flags."""


_UNNAMED = "scene"  # the part of settings whose flags do not name it
_registry = tyro.constructors.ConstructorRegistry()
_FIELD = re.compile(r"[a-z][a-z0-9_.]*")


def parse(
    name: str,
    settings: type[SettingsT],
    argv: Sequence[str],
    description: str,
    default: SettingsT | None = None,
    renamed: Mapping[str, str] = {},
) -> SettingsT:
    """Returns the settings of a command line.

    Args:
      name: subcommand, for the usage line.
      settings: dataclass of the flags.
      argv: words after the subcommand.
      description: text above the flags in `--help`.
      default: values of fields that `argv` does not set; by default those of `settings`.
      renamed: flags of the previous release -> flags of this one.

    Raises:
      errors.UsageError: a flag is unknown, or its value has the wrong type or range.
    """
    words = [_current(word, renamed) for word in argv]
    with tyro_errors.on_parse_error(functools.partial(_refuse, default or settings)):
        parsed = tyro.cli(
            settings,
            args=words,
            prog=f"starjax {name}",
            description=description,
            default=tyro.MISSING_NONPROP if default is None else default,
            registry=_registry,
        )
    limits.check(parsed)
    return parsed


def typed_value(field: str, argv: Sequence[str]) -> str | None:
    """Returns the word that follows a field's flag, the last one counts; None without the flag.

    Defaults of other flags depend on such a word; the parser, which needs the defaults, comes later
    and refuses a wrong one.
    """
    value = None
    for word, following in zip(argv, [*argv[1:], ""], strict=True):
        name, equals, inner = word.partition("=")
        if name.replace("_", "-") == flag(field):
            value = inner if equals else following
    return value


def flags(settings: Any) -> list[str]:
    """Returns all flags of a (nested) dataclass, such as `--train.steps`, and `no-` flags."""
    names = []
    for name, _, hint in limits.fields(settings):
        if tyro.conf.Positional not in getattr(hint, "__metadata__", ()):
            names += [flag(name)]
            before, dot, last = name.rpartition(".")
            names += [flag(f"{before}{dot}no_{last}")] if hint is bool else []
    return names


def flag(field: str) -> str:
    """Returns the flag of a field, e.g. `--task` for `scene.task`, `--from` for `from_`."""
    return f"--{field.removeprefix(f'{_UNNAMED}.').rstrip('_').replace('_', '-')}"


def spelled(error: errors.UsageError) -> str:
    """Returns the line of an error, with flags for the names of fields."""
    line = str(error)
    if _FIELD.fullmatch(error.argument):
        line = line.replace(error.argument, flag(error.argument), 1)
    # Elsewhere in it a field without a dot would be an ordinary word.
    known = [name for name, *_ in limits.fields(config_lib.RunConfig) if "." in name]
    within = rf"(?<![\w./-])({'|'.join(map(re.escape, known))})\b"
    return re.sub(within, lambda match: flag(match[0]), line)


def typed(name: str, argv: Sequence[str]) -> str:
    """Returns the command line, for results."""
    return shlex.join(["starjax", name, *argv])


def _current(word: str, renamed: Mapping[str, str]) -> str:
    """Returns a word of the command line, with this release's name if it is a renamed flag."""
    flag_, equals, value = word.partition("=")
    if flag_ not in renamed:
        return word
    errors.warn_renamed(flag_, renamed[flag_])
    return f"{renamed[flag_]}{equals}{value}"


def _refuse(settings: Any, event: Any) -> NoReturn:
    """Raises UsageError in place of an error of tyro.

    tyro prints a box of five lines, and its public interface hands out neither the argument nor the
    value. Its hook for errors does; it is private, so a release of tyro may change it: pyproject
    names the releases that are known to have it.
    """
    argument = getattr(event, "argument", None)
    match event:
        case tyro_errors.UnrecognizedArgs(tokens=[token, *_]):
            near = errors.nearest(token.partition("=")[0], flags(settings))
            raise errors.UsageError("FLAG", f"one of {event.prog} --help", token, near)
        case tyro_errors.MissingArgs(missing_arguments=missing):
            names = " ".join(str(context.arg.lowered.metavar) for context in missing)
            raise errors.UsageError(names, "a value", "none")
        case tyro_errors.InvalidChoice(value=value, choices=choices):
            errors.choice(_name(argument), value, choices)
        case tyro_errors.BadValue():
            raise errors.UsageError(_name(argument), "a value", "none")
    kinds = {"INT": "a whole number", "FLOAT": "a number"}
    metavar = argument.lowered.metavar if argument else ""
    kind = next((text for name, text in kinds.items() if name in metavar), "another value")
    *_, got = re.findall(r"'[^']*'", event.message) or [event.message.splitlines()[0]]
    raise errors.UsageError(_name(argument), kind, got)


def _name(argument: Any) -> str:
    return argument.lowered.name_or_flags[-1] if argument else "FLAG"


_busy: list[type] = []  # dataclasses whose fields tyro is listing


@_registry.struct_rule
def _with_ranges(
    info: tyro.constructors.StructTypeInfo,
) -> tyro.constructors.StructConstructorSpec | None:
    """Appends range and default to the help of each field."""
    if not dataclasses.is_dataclass(info.type) or info.type in _busy:
        return None
    _busy.append(info.type)
    try:
        spec = tyro.constructors.ConstructorRegistry.get_struct_spec(info)
    finally:
        _busy.pop()
    if not isinstance(spec, tyro.constructors.StructConstructorSpec):
        return None
    fields, declared = [], {field.name: field for field in dataclasses.fields(info.type)}
    for field in spec.fields:
        if declared[field.name].metadata == limits.INLINE:
            inline = Annotated[type(field.default), tyro.conf.arg(name="")]
            fields.append(dataclasses.replace(field, type=inline))
            continue
        plain = field.name.rstrip("_")  # a word of Python's, such as `from`, ends in one
        name = "" if field.name == _UNNAMED else plain if plain != field.name else None
        range_and_default = functools.partial(_hint, limits.within(field.type))
        aliases = _ALIASES.get((info.type, plain))
        hint = tyro.conf.arg(name=name, aliases=aliases, help_behavior_hint=range_and_default)
        # What stands on the field itself comes later, and wins.
        kind, *rest = typing.get_args(field.type) if _is_annotated(field.type) else [field.type]
        fields.append(dataclasses.replace(field, type=Annotated[(kind, hint, *rest)]))
    return dataclasses.replace(spec, fields=tuple(fields))


def _is_annotated(hint: Any) -> bool:
    return typing.get_origin(hint) is Annotated


def _hint(limit: limits.Range | None, default: str) -> str:
    """Returns `(1 to 8; default: 8)`, or the part of it that exists."""
    has_default = default not in ("", "None", "''")
    parts = [str(limit)] * bool(limit) + [f"default: {default}"] * has_default
    return f"({'; '.join(parts)})" if parts else ""
