"""Command lines for frozen dataclasses, by tyro; mistakes are one line. Needs no jax, no numpy."""

import contextlib
import dataclasses
import functools
import io
import os
import re
import shlex
import sys
import typing
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, TypeVar

import tyro
from tyro import _errors as tyro_errors  # private: see _refuse

from starjax.cli import help_pages
from starjax.core import config as config_lib
from starjax.core import errors, limits

if TYPE_CHECKING:  # for annotations alone
    from _typeshed import DataclassInstance

SettingsT = TypeVar("SettingsT", bound="DataclassInstance")
StructInfo = tyro.constructors.StructTypeInfo
StructSpec = tyro.constructors.StructConstructorSpec
StructRule = Callable[[StructInfo], StructSpec | None]

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

_ALIASES = {(config_lib.SceneConfig, "camera"): ("--cameras",)}


@dataclasses.dataclass(frozen=True)
class NoFlags:
    """Settings of a command without flags."""


class Declared(Exception):
    """The flags of a command, raised by `parse` for the words `DECLARE`.

    Attributes:
      settings: dataclass of the flags.
      default: values of its fields, or None.
    """

    def __init__(self, settings: type, default: Any) -> None:
        super().__init__()
        self.settings, self.default = settings, default


DECLARE: list[str] = []  # command line that asks a command for its flags instead of running it

_UNNAMED = "scene"  # the part of settings whose flags do not name it
_FIELD = re.compile(r"[a-z][a-z0-9_.]*")


def parse(
    name: str,
    settings: type[SettingsT],
    argv: Sequence[str],
    description: str,
    default: SettingsT | None = None,
) -> SettingsT:
    """Returns the settings of a command line.

    Args:
      name: subcommand, for the usage line.
      settings: dataclass of the flags.
      argv: words after the subcommand.
      description: text above the flags in `--help`.
      default: values of fields that `argv` does not set; by default those of `settings`.

    Raises:
      errors.UsageError: a flag is unknown, or its value has the wrong type or range.
    """
    if argv is DECLARE:
        raise Declared(settings, default)
    words = [_expanded(word) for word in argv]
    cli = functools.partial(
        tyro.cli,
        settings,
        prog=f"starjax {name}",
        description="",
        default=tyro.MISSING_NONPROP if default is None else default,
    )
    if kind := help_pages.requested(words):
        print(_help(cli, kind, name, description))
        raise SystemExit(0)
    with tyro_errors.on_parse_error(functools.partial(_refuse, default or settings)):
        parsed = cli(args=words, registry=registry(with_ranges))
    limits.check(parsed)
    return parsed


def registry(*rules: StructRule) -> tyro.constructors.ConstructorRegistry:
    """Makes a registry of tyro with rules for dataclasses; later rules take precedence."""
    made = tyro.constructors.ConstructorRegistry()
    for rule in rules:
        made.struct_rule(rule)
    return made


def _help(cli: Callable[..., Any], kind: str, name: str, description: str) -> str:
    """Returns the help page of a command, the short or the full one."""

    def flags(*rules: StructRule) -> str:
        # tyro breaks a description anywhere in a word, so the page has its own.
        shown = io.TextIOWrapper(io.BytesIO(), getattr(sys.stdout, "encoding", None) or "utf-8")
        with contextlib.redirect_stdout(shown), contextlib.suppress(SystemExit):
            cli(args=["--help"], registry=registry(*rules))
        shown.seek(0)
        return shown.read()

    help_pages.widen()
    full = flags(with_ranges)
    text = full if kind == help_pages.FULL else flags(with_ranges, _first_only)
    hides = text != full
    return help_pages.page(
        text, description, f"starjax {name} {help_pages.FULL}: all flags" * hides
    )


def typed_value(field: str, argv: Sequence[str]) -> str | None:
    """Returns the word that follows a field's flag, the last one counts; None without the flag.

    Defaults of other flags depend on such a word; the parser, which needs the defaults, comes later
    and refuses a wrong one.
    """
    value = None
    for word, following in zip(argv, [*argv, ""][1:], strict=True):
        name, equals, inner = word.partition("=")
        if name.replace("_", "-") == flag(field):
            value = inner if equals else following
    return value


def flags(settings: "DataclassInstance | type[DataclassInstance]") -> list[str]:
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


def _expanded(word: str) -> str:
    """Replaces the `~` that begins a value; a shell leaves that of `--out=~/runs` as it is."""
    name, equals, value = word.partition("=") if word.startswith("-") else ("", "", word)
    return f"{name}{equals}{os.path.expanduser(value)}"


def _refuse(settings: "DataclassInstance | type[DataclassInstance]", event: Any) -> NoReturn:
    """Raises UsageError in place of an error of tyro.

    tyro prints a box of five lines, and its public interface hands out neither the argument nor the
    value. Its hook for errors does; it is private, so a release of tyro may change it: pyproject
    names the releases that are known to have it.
    """
    argument = getattr(event, "argument", None)
    match event:
        case tyro_errors.UnrecognizedArgs(tokens=[token, *_]):
            near = errors.nearest(token.partition("=")[0], flags(settings))
            expected = f"a flag of {event.prog} (see {event.prog} {help_pages.FULL})"
            raise errors.UsageError("FLAG", expected, token, near)
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


_busy: list[tuple[Any, type]] = []  # rules at work, and the dataclasses whose fields they list


def others(rule: StructRule, info: StructInfo) -> StructSpec | None:
    """Returns the fields of a dataclass by the rules before `rule`; None for other types."""
    is_settings = isinstance(info.type, type) and dataclasses.is_dataclass(info.type)
    if not is_settings or (rule, info.type) in _busy:
        return None
    _busy.append((rule, info.type))
    try:
        spec = tyro.constructors.ConstructorRegistry.get_struct_spec(info)
    finally:
        _busy.pop()
    return spec if isinstance(spec, StructSpec) else None


def _first_only(info: StructInfo) -> StructSpec | None:
    """Hides the fields that the short help leaves out."""
    if (spec := others(_first_only, info)) is None:
        return None
    if (first := help_pages.first(info.type)) is None:
        return spec
    inline = {f.name for f in dataclasses.fields(info.type) if f.metadata == limits.INLINE}
    fields = []
    for field in spec.fields:
        is_section = _section(field.type) and field.name not in inline
        kind = field.type if field.name in first or is_section else tyro.conf.Suppress[field.type]
        fields.append(dataclasses.replace(field, type=kind))
    return dataclasses.replace(spec, fields=tuple(fields))


def with_ranges(info: StructInfo) -> StructSpec | None:
    """Appends range and default to the help of each field."""
    spec = others(with_ranges, info)
    if spec is None:
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
        hint = tyro.conf.arg(
            name=name,
            aliases=aliases,
            help_behavior_hint=range_and_default,
            metavar=_optional_number(field.type),
        )
        # What stands on the field itself comes later, and wins.
        kind, *rest = typing.get_args(field.type) if is_annotated(field.type) else [field.type]
        # By default the title of a section would be the help of the field before it.
        title = {"helptext": section.__doc__} if (section := _section(kind)) else {}
        fields.append(dataclasses.replace(field, type=Annotated[(kind, hint, *rest)], **title))
    return dataclasses.replace(spec, fields=tuple(fields))


def _section(hint: Any) -> Any:
    """Returns the dataclass of a field with settings of its own, None for other fields."""
    kind = typing.get_args(hint)[0] if is_annotated(hint) else hint
    return kind if dataclasses.is_dataclass(kind) else None


def _optional_number(hint: Any) -> str | None:
    """Returns the metavar of a number that may be None, None for other types."""
    kind = typing.get_args(hint)[0] if is_annotated(hint) else hint
    metavars = {int | None: "INT", float | None: "FLOAT"}
    return next((name for optional, name in metavars.items() if kind == optional), None)


def is_annotated(hint: Any) -> bool:
    """Returns True for `Annotated[...]`."""
    return typing.get_origin(hint) is Annotated


def _hint(limit: limits.Range | None, default: str) -> str:
    """Returns `(1 to 8; default: 8)`, or the part of it that exists."""
    has_default = default not in ("", "None", "''")
    parts = [str(limit)] * bool(limit) + [f"default: {default}"] * has_default
    return f"({'; '.join(parts)})" if parts else ""
