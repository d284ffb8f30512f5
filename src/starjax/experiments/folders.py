"""What lies where in a run's folder, whose settings it was made with, and how long each stage took.

<out>/demos-<digest>/      demonstrations, shared by all methods
<out>/timings.json         seconds a stage, summed over every start
<out>/<method>/config.json settings; a folder made with others is refused, not mixed
<out>/<method>/...         checkpoints, weights, evaluation, result.json
<out>/report/              tables, figures, video, page
"""

import contextlib
import dataclasses
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from starjax import config as config_lib
from starjax.experiments import methods
from starjax.runtime import files

# Settings that decide a stage's outcome; the others may change between two starts.
TRAINED_WITH = ("seed", "demos", "policy", "train")
# Settings of those that only decide how often something is written.
_FREE = {"train.keep-checkpoints"}


def weights(config: config_lib.RunConfig, method: str) -> Path:
    """Folder of the weights that `method` runs on: those of another method for some."""
    return Path(config.out) / methods.METHODS[method].weights_of


def twin(method: str) -> str:
    """The first method of Table II that behaves as `method` does, so that both are scored once."""

    def behaviour(name: str) -> config_lib.Method:
        return methods.METHODS[name]._replace(label="", group="")

    return next(name for name in methods.METHODS if behaviour(name) == behaviour(method))


def selected(config: config_lib.RunConfig) -> list[str]:
    """The methods of a run, in the order of Table II."""
    return list(methods.METHODS) if config.method == "all" else [config.method]


def claim(folder: Path, config: config_lib.RunConfig, parts: tuple[str, ...]) -> None:
    """Writes a folder's config.json, or makes sure that the one there has the same `parts`.

    Raises:
      config.UsageError: naming the first setting that differs.
    """
    path = folder / "config.json"
    wanted = json.loads(json.dumps(dataclasses.asdict(config)))
    if path.exists():
        found = json.loads(path.read_text())
        for name in (name for part in parts for name in _flat(wanted[part], part)):
            before, now = _flat_value(found, name), _flat_value(wanted, name)
            if before != now and name not in _FREE:
                raise config_lib.UsageError(
                    f"--{name}: {folder} was made with {before}, got {now}; "
                    "choose another folder by --out, or remove that one"
                )
        wanted = {**wanted, **{part: found[part] for part in wanted if part not in parts}}
    files.write_json(path, wanted)


def read_config(folder: Path) -> config_lib.RunConfig:
    """Settings of a finished or running method folder."""
    path = folder / "config.json"
    if not path.is_file():
        raise config_lib.UsageError(
            f"{folder}: expected a run's method folder such as runs/cpu/stardiff, no config.json"
        )
    return config_lib.from_dict(config_lib.RunConfig, json.loads(path.read_text()))


@contextlib.contextmanager
def timed(out: Path, stage: str) -> Iterator[None]:
    """Adds the seconds spent inside to `stage` of timings.json, also after Ctrl-C."""
    start = time.monotonic()
    try:
        yield
    finally:
        spent = timings(out)
        spent[stage] = round(spent.get(stage, 0.0) + time.monotonic() - start, 2)
        files.write_json(out / "timings.json", spent)


def timings(out: Path) -> dict[str, float]:
    """Seconds a stage so far."""
    path = out / "timings.json"
    return json.loads(path.read_text()) if path.exists() else {}


def _flat(value: Any, prefix: str) -> list[str]:
    if not isinstance(value, dict):
        return [prefix]
    return [f"{prefix}.{name.replace('_', '-')}" for name in value]


def _flat_value(values: dict[str, Any], name: str) -> Any:
    part, _, field = name.partition(".")
    found = values.get(part)
    return found.get(field.replace("-", "_")) if field and found is not None else found
