"""What lies where in a run's folder, and whose settings it was made with.

<out>/demos-<digest>/      demonstrations, shared by all methods
<out>/timings.json         seconds a stage, summed over every start
<out>/<method>/config.json settings; a folder made with others is refused, not mixed
<out>/<method>/...         checkpoints, weights, evaluation, result.json
<out>/report/              tables, figures, video, page
"""

import dataclasses
import json
import shlex
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from starjax import config as config_lib
from starjax import methods
from starjax.runtime import files

# What decides the weights; the rest may change between two starts.
TRAINED_WITH = ("seed", "demos", "policy", "train")
# Of those, what leaves the weights alone.
_FREE = {"--train.keep-checkpoints", "--train.checkpoint-every", "--train.steps-per-call"}
_BESIDE = ("dataset", "encoder")  # what a config.json records beside the settings


def existing(run: str) -> Path:
    """The absolute path of a method's folder that a command line names.

    Raises:
      config.UsageError: it is not called as a method is.
    """
    folder = Path(run).absolute()  # a link is called what its user calls it
    if folder.name not in methods.METHODS:
        folder = folder.resolve()
    if folder.name not in methods.METHODS:
        files = [file for file in (folder, folder / "policy.safetensors") if file.is_file()]
        hint = (
            f"starjax evaluate --policy {shlex.quote(str(files[0]))} scores that" if files else ""
        )
        within = [f"{run}/{name}" for name in methods.METHODS if (folder / name).is_dir()]
        hint = hint or (f"there is {', '.join(within)}" if within else "")
        raise config_lib.UsageError(
            f"RUN: expected a method's folder such as runs/cpu/stardiff, got {run or 'none'}"
            + (f"; {hint}" if hint else "")
        )
    return folder


def weights(out: Path, method: str) -> Path:
    """The file of the weights that `method` runs on: those of another method for some."""
    return out / methods.METHODS[method].weights_of / "policy.safetensors"


def twins(method: str) -> list[str]:
    """Other methods that behave just as `method` does, so that one evaluation serves both."""
    return [
        name for name in methods.METHODS if name != method and behaviour(name) == behaviour(method)
    ]


def adopt_twin(out: Path, method: str) -> None:
    """Takes over the evaluation of a twin that was scored before, chunk by chunk."""
    for name in twins(method):
        if (out / name / "evaluation").is_dir() and not (out / method / "evaluation").exists():
            staged = out / method / ".evaluation"
            shutil.rmtree(staged, ignore_errors=True)
            try:
                shutil.copytree(out / name / "evaluation", staged)
            except shutil.Error as error:
                shutil.rmtree(staged, ignore_errors=True)
                source, _, why = error.args[0][0]
                raise files.StorageError(f"cannot copy {source} to {staged}: {why}") from error
            staged.rename(staged.with_name("evaluation"))


def behaviour(method: str) -> methods.Method:
    """A row of Table II without its names."""
    return methods.METHODS[method]._replace(label="", group="")


def selected(config: config_lib.RunConfig) -> list[str]:
    """The methods of a run, in the order of Table II."""
    return list(methods.METHODS) if config.method == "all" else [config.method]


def is_under_way(folder: Path) -> bool:
    """Whether `folder` has trials of an evaluation that has no result.json yet."""
    plan, result = folder / "evaluation" / "plan.json", folder / "result.json"
    if not plan.exists() or not any(plan.parent.glob("chunk_*")):
        return False
    return not result.exists() or result.stat().st_mtime_ns < plan.stat().st_mtime_ns


def claim(
    folder: Path, config: config_lib.RunConfig, dataset: str, encoder: str | None = None
) -> None:
    """Writes the config.json of a method's folder; weights there must have been trained likewise.

    Args:
      folder: of one method.
      config: settings of this run.
      dataset: name of its demonstrations, which also tells the scene that they were made in.
      encoder: fingerprint of its frozen vision encoder; None if it has none, or is trained.

    Raises:
      config.UsageError: naming the first setting that differs, or what weights are there without.
    """
    wanted = _as_json(config)
    started = (folder / "policy.safetensors").exists() or any(folder.glob("checkpoints/step_*"))
    found = _recorded(folder) if (folder / "config.json").exists() else {}
    if started and not found:
        raise config_lib.UsageError(
            f"{folder}: expected the config.json that its weights were trained with, got none; "
            f"{_remedy(folder)}"
        )
    if started:
        before = _as_json(_settings(folder, found))
        for name in (name for part in TRAINED_WITH for name in _flat(wanted[part], part)):
            _refuse(folder, f"--{name}", _value(before, name), _value(wanted, name))
        _refuse(folder, "demonstrations", found.get("dataset", dataset), dataset)
        encoder_before = found.get("encoder") or encoder
        _refuse(folder, "--policy.encoder-weights", encoder_before, encoder or encoder_before)
    known = found.get("encoder") if started or config.policy.freeze_encoder else None
    frozen = encoder or known
    extra = {"dataset": dataset} | ({"encoder": frozen} if frozen else {})
    files.write_json(folder / "config.json", {**wanted, **extra})


def read_config(folder: Path) -> config_lib.RunConfig:
    """Settings of a finished or running method folder."""
    return _settings(folder, _recorded(folder))


def trained_alike(one: dict[str, Any], other: dict[str, Any], *parts: str) -> bool:
    """Whether two configurations from JSON agree on what decides the weights, and on `parts`.

    Settings that did not exist yet when one of them was written have their default.
    """
    one, other = (_as_json(_from_json(values)) for values in (one, other))
    return all(one[part] == other[part] for part in (*TRAINED_WITH, *parts))


def differing(configs: Sequence[dict[str, Any]]) -> list[str]:
    """Flags of demonstrations, policy and training that configurations from JSON disagree on.

    Settings that one of them lacks have their default there; what leaves the weights alone is left
    out.
    """
    usual = _as_json(config_lib.RunConfig())

    def flags(values: dict[str, Any]) -> dict[str, Any]:
        full = {part: usual[part] | values.get(part, {}) for part in ("demos", "policy", "train")}
        names = (name for part in full for name in _flat(full[part], part))
        return {f"--{name}": _value(full, name) for name in names}

    rows = [flags(config_lib.upgraded(values)) for values in configs]
    return [
        flag
        for flag in dict.fromkeys(flag for row in rows for flag in row)
        if flag not in _FREE and any(row.get(flag) != rows[0].get(flag) for row in rows)
    ]


def _recorded(folder: Path) -> dict[str, Any]:
    """The content of a method folder's config.json."""
    path = folder / "config.json"
    if not path.is_file():
        remedy = f"; {_remedy(folder)}" if (folder / "policy.safetensors").is_file() else ""
        raise config_lib.UsageError(
            f"{folder}: expected a run's method folder such as runs/cpu/stardiff, got no "
            f"config.json{remedy}"
        )
    try:
        found = files.read_json(path)
    except ValueError as error:
        raise config_lib.UsageError(f"{error}; {_remedy(folder)}") from error
    if not found:
        raise config_lib.UsageError(
            f"{path} is damaged: expected settings, got none; {_remedy(folder)}"
        )
    return found


def _remedy(folder: Path) -> str:
    """What to do about a method's folder whose settings are lost, or others."""
    weights = folder / "policy.safetensors"
    scores = f"; starjax evaluate --policy {shlex.quote(str(weights))} scores its weights"
    return "train in another folder by --out, or remove this one" + scores * weights.is_file()


def _settings(folder: Path, values: dict[str, Any]) -> config_lib.RunConfig:
    try:
        return _from_json(values)
    except (TypeError, ValueError) as error:
        raise config_lib.UsageError(
            f"{folder / 'config.json'}: {error}; {_remedy(folder)}"
        ) from error


def _from_json(values: dict[str, Any]) -> config_lib.RunConfig:
    """Settings from a config.json, without what else it records."""
    kept = {name: value for name, value in dict(values).items() if name not in _BESIDE}
    return config_lib.from_dict(config_lib.RunConfig, config_lib.upgraded(kept))


def _as_json(config: config_lib.RunConfig) -> dict[str, Any]:
    return json.loads(json.dumps(dataclasses.asdict(config)))


def _refuse(folder: Path, name: str, before: Any, now: Any) -> None:
    if before != now and name not in _FREE:
        raise config_lib.UsageError(
            f"{name}: {folder} was made with {before}, got {now}; choose another folder by --out, "
            "or remove that one"
        )


def _flat(value: Any, prefix: str) -> list[str]:
    if not isinstance(value, dict):
        return [prefix]
    return [f"{prefix}.{name.replace('_', '-')}" for name in value]


def _value(values: dict[str, Any], name: str) -> Any:
    part, _, field = name.partition(".")
    return values[part][field.replace("-", "_")] if field else values[part]
