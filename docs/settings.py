"""Draws the reference of commands and settings from the dataclasses behind `--help`."""

import dataclasses
import importlib
import inspect
import re
import typing

from starjax import cli
from starjax.cli import options, presets
from starjax.core import config, limits

_TRAILING = re.compile(r"^\s+(\w+): .*?#\s*(.*)$")


def comments(settings: type) -> dict[str, str]:
    """Returns field -> comment, of its line or of the lines above it."""
    texts, above = {}, []
    kinds = filter(dataclasses.is_dataclass, reversed(settings.__mro__))
    for line in "".join(map(inspect.getsource, kinds)).splitlines():
        text = line.strip()
        if text.startswith("#"):
            above.append(text.lstrip("# "))
            continue
        name = re.match(r"\s+(\w+): ", line)
        if name and name[1] in {field.name for field in dataclasses.fields(settings)}:
            trailing = _TRAILING.match(line)
            texts[name[1]] = trailing[2] if trailing else " ".join(above)
        above = []
    return texts


def rows(settings: type, default: object, prefix: str = "") -> list[tuple[str, str, str]]:
    """Returns (flag, default, help) of every field, including nested ones."""
    table_rows, helps = [], comments(settings)
    inline = {
        field.name for field in dataclasses.fields(settings) if field.metadata == limits.INLINE
    }
    for name, hint in typing.get_type_hints(settings, include_extras=True).items():
        value = getattr(default, name, dataclasses.MISSING)
        if name in inline:
            table_rows += rows(type(value), value, prefix)
            continue
        if dataclasses.is_dataclass(hint):
            if value is dataclasses.MISSING and hint.__module__ == settings.__module__:
                value = hint()  # a command's own; another module's depends on the machine
            table_rows += rows(hint, value, f"{prefix}{name}.")
            continue
        is_word = options.tyro.conf.Positional in getattr(hint, "__metadata__", ())
        flag = name.upper() if is_word else options.flag(prefix + name)
        table_rows.append((flag, shown(value), helps[name] + choices(hint)))
    return table_rows


def choices(hint: object) -> str:
    """Returns the values that a field can have, if they are few."""
    while typing.get_origin(hint) is typing.Annotated:
        hint = typing.get_args(hint)[0]
    if typing.get_origin(hint) is not typing.Literal:
        return ""
    return f" ({', '.join(f'`{choice}`' for choice in typing.get_args(hint))})"


def shown(value: object) -> str:
    """Returns the text of a default in a table's cell."""
    if value is dataclasses.MISSING or value in ("", None, ()):
        return ""
    if isinstance(value, bool):
        return "on" if value else "off"
    return " ".join(map(str, value)) if isinstance(value, tuple) else f"{value}"


def table(head: list[str], lines: list[tuple[str, ...]]) -> str:
    """Returns a table in Markdown."""
    cells = [head, ["---"] * len(head), *lines]
    return "\n".join(f"| {' | '.join(line)} |" for line in cells)


def is_flags(kind: object, module: str) -> bool:
    """Returns True for the class of a command module's flags."""
    return inspect.isclass(kind) and kind.__module__ == module and kind.__name__.endswith("Args")


def commands() -> str:
    """Returns a section per command, with its flags."""
    parts: list[str] = []
    seen: dict[tuple[str, str], str] = {}  # (flag, help) -> the first command with it
    for name, (module, summary, _) in cli.COMMANDS.items():
        module, _, function = module.partition(":")
        loaded = importlib.import_module(module)
        description = getattr(loaded, function.upper() or "DESCRIPTION", f"{summary}.")
        flags_of = [kind for kind in vars(loaded).values() if is_flags(kind, module)]
        text, _, examples = description.partition("\n\nExamples:\n")
        parts += ["", f"## starjax {name}", "", text.partition("\n\n")[0]]
        parts += ["", "```bash", *map(str.strip, examples.splitlines()), "```"]
        if name in ("run", "collect", "train"):
            parts += ["", "Flags: the [settings of a run](config.md)."] * (name == "run")
        elif flags_of:
            lines = rows(flags_of[0], flags_of[0])
            own = [line for line in lines if seen.setdefault(line[::2], name) == name]
            if own:
                drawn = [(f"`{flag}`", *rest) for flag, *rest in own]
                parts += ["", table(["flag", "default", "meaning"], drawn)]
            parts += shared(seen, [line for line in lines if line not in own])
    return "\n".join(parts) + "\n"


def shared(seen: dict[tuple[str, str], str], lines: list[tuple[str, str, str]]) -> list[str]:
    """Returns a line per earlier command that explains some of a command's flags."""
    by_command: dict[str, list[str]] = {}
    for flag, value, text in lines:
        word = f"`{flag} {value}`" if value else f"`{flag}`"
        by_command.setdefault(seen[flag, text], []).append(word)
    return [
        f"\nAs in [{name}](#starjax-{name}): {', '.join(flags)}."
        for name, flags in by_command.items()
    ]


def settings() -> str:
    """Returns tables of all settings of a run, with the values of every preset."""
    names = list(presets.PRESETS)
    parts = [
        "Columns of presets show changes of the defaults, and – for options of other learners.",
    ]
    groups: dict[str, list] = {}
    for row in rows(config.RunConfig, config.RunConfig()):
        first, dot, _ = row[0].removeprefix("--").partition(".")
        groups.setdefault(first if dot else "run", []).append(row)
    changed = {
        name: {flag: value for flag, value, _ in rows(config.RunConfig, preset)}
        for name, preset in presets.PRESETS.items()
    }
    for group, lines in groups.items():
        parts += ["", f"## {group}", ""]
        drawn = []
        for flag, value, text in lines:
            cells = [changed[name].get(flag, "–") for name in names]  # not an option of its learner
            differs = [cell if cell != value and group != "run" else "" for cell in cells]
            drawn.append((f"`{flag}`", value, differs, text))
        used = [i for i in range(len(names)) if any(line[2][i] for line in drawn)]
        lines = [(flag, value, *(d[i] for i in used), *rest) for flag, value, d, *rest in drawn]
        head = ["flag", "default", *(names[i] for i in used), "meaning"]
        parts.append(table(head, lines))
    return "\n".join(parts) + "\n"
