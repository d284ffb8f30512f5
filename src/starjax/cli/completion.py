"""`starjax completion`: the script with which a shell completes commands, flags and names."""

import contextlib
import dataclasses
import typing
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Union

import tyro

from starjax import cli
from starjax.cli import options
from starjax.core import extensions, methods
from starjax.core.learners import LEARNERS
from starjax.core.registry import load
from starjax.evaluation.disturbances import DISTURBANCES
from starjax.policies import packaged
from starjax.sim import registries

DESCRIPTION = """Prints the completion script of a shell: commands, flags and their values.

The script lists tasks, arms and the like that are installed now; print it again after an update.

Examples:
  source <(starjax completion bash)
  starjax completion zsh > ~/.zfunc/_starjax
  starjax completion fish > ~/.config/fish/completions/starjax.fish"""

_PROGRAM = "starjax"
# tyro's bash script completes files only after flags: here also words without a match.
_BASH_FILES = f"""
_{_PROGRAM}() {{
  _tyro_{_PROGRAM} "$@"
  [[ -n "${{COMPREPLY[*]}}" ]] || COMPREPLY=()
}}
complete -o default -F _{_PROGRAM} {_PROGRAM}"""

Shell = Literal["bash", "zsh", "fish"]


@dataclasses.dataclass(frozen=True)
class CompletionArgs:
    """Flags of the command."""

    # name of the shell
    shell: Annotated[Shell, tyro.conf.Positional, tyro.conf.arg(metavar="SHELL")]


def main(argv: Sequence[str]) -> int:
    """Prints the script."""
    args = options.parse("completion", CompletionArgs, argv, DESCRIPTION)
    commands: Any = Union[*map(_command, cli.COMMANDS)]
    with contextlib.suppress(SystemExit):
        tyro.cli(
            commands,
            prog=_PROGRAM,
            args=["--tyro-write-completion", args.shell, "-"],
            registry=options.registry(options.with_ranges, _with_names),
        )
    if args.shell == "bash":
        print(_BASH_FILES)
    return 0


def _command(name: str) -> Any:
    """Returns the type of a command for tyro: its settings, as `starjax NAME` would parse them."""
    try:
        cli.load(name)(options.DECLARE)
    except options.Declared as flags:
        default = tyro.MISSING_NONPROP if flags.default is None else flags.default
        named = tyro.conf.subcommand(name, default=default, description=str(cli.COMMANDS[name][1]))
        return Annotated[flags.settings, named]
    raise TypeError(f"{name} parses no flags")


def _names() -> dict[str, list[str]]:
    """Returns the values of the flags that take names: field -> names."""
    return {
        "task": registries.tasks.names(),
        "arm": registries.arms.names(),
        "tool": registries.tools.names(),
        "method": [*methods.METHODS, "all"],
        "learner": LEARNERS.names(),
        **{kind: load(row.registry).names() for kind, row in extensions.kinds().items()},
        "disturbance": DISTURBANCES.names(),
        "policy": packaged.names(),
        "compare_with": ["expert", *packaged.names()],
        "encoder_weights": packaged.names(),
    }


def _with_names(info: options.StructInfo) -> options.StructSpec | None:
    """Gives text fields the names that exist; other texts are files, which the shell completes."""
    spec = options.others(_with_names, info)
    if spec is None:
        return None
    names, fields = _names(), []
    for field in spec.fields:
        is_annotated = options.is_annotated(field.type)
        kind, *rest = typing.get_args(field.type) if is_annotated else [field.type]
        known = names.get(field.name, ())
        value = Literal[tuple(known)] if known else Path
        if kind is str:
            default = known[0] if known else Path()
            field = dataclasses.replace(field, type=Annotated[(value, *rest)], default=default)
        elif kind == tuple[str, ...]:
            several = Annotated[(tuple[value, ...], *rest)]
            field = dataclasses.replace(field, type=several, default=())
        fields.append(field)
    return dataclasses.replace(spec, fields=tuple(fields))
