"""Layout of a run's folder, and whose settings it was made with.

<out>/demos-<digest>/      demonstrations, shared by all methods
<out>/timings.json         seconds a stage, summed over every start
<out>/<method>/config.json settings; a folder made with others is refused, not mixed
<out>/<method>/...         checkpoints, weights, evaluation, result.json
<out>/report/              tables, figures, video, page
"""

import shlex
import shutil
from pathlib import Path
from typing import Any

from starjax.core import config as config_lib
from starjax.core import config_json, errors, learners, methods, sources
from starjax.runtime import files

_BESIDE = (
    "dataset",
    "encoder",
    "jax_settings",
    "parts",
    "source",
)  # further entries of a config.json


def existing(run: str) -> Path:
    """Returns the absolute path of a method's directory on the command line.

    Raises:
      errors.UsageError: it is not called as a method is.
    """
    folder = Path(run).absolute()  # a symbolic link keeps its own name
    if folder.name not in methods.METHODS:
        folder = folder.resolve()
    if folder.name not in methods.METHODS:
        files = [file for file in (folder, folder / "policy.safetensors") if file.is_file()]
        hint = (
            f"starjax evaluate --policy {shlex.quote(str(files[0]))} scores that" if files else ""
        )
        within = [f"{run}/{name}" for name in methods.METHODS if (folder / name).is_dir()]
        hint = hint or (f"there is {', '.join(within)}" if within else "")
        expected = "a method's folder such as runs/cpu/stardiff"
        raise errors.UsageError("RUN", expected, run or "none", hint)
    return folder


def weights(out: Path, method: str) -> Path:
    """Returns the file of a method's weights, which some methods share."""
    return out / methods.METHODS[method].weights_of / "policy.safetensors"


def equivalent_methods(method: str) -> list[str]:
    """Returns methods of equal behaviour, which can share an evaluation."""
    return [
        name
        for name in methods.METHODS
        if name != method and methods.behaviour(name) == methods.behaviour(method)
    ]


def adopt_equivalent(out: Path, method: str) -> None:
    """Copies the evaluation of an equivalent method, if there is one."""
    for name in equivalent_methods(method):
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


def is_under_way(folder: Path) -> bool:
    """Returns True for a directory with trials of an evaluation but without its result."""
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
      dataset: name of the demonstrations, which identifies their scene.
      encoder: fingerprint of the frozen image encoder, or None.

    Raises:
      errors.UsageError: a setting differs, or the settings of existing weights are missing.
    """
    # Imported here because it imports jax.
    from starjax.runtime import jax_settings

    policy = config.policy
    networks = policy.learner, policy.encoder, policy.depth_encoder
    now_parts = sources.record(learners.parts(folder.name, *networks))
    started = (folder / "policy.safetensors").exists() or any(folder.glob("checkpoints/step_*"))
    recorded = _recorded(folder) if (folder / "config.json").exists() else {}
    if started and not recorded:
        expected = "the config.json that its weights were trained with"
        raise errors.UsageError(str(folder), expected, "none", _remedy(folder))
    if started:
        before, now = map(config_json.weight_settings, (_settings(folder, recorded), config))
        for name, value in now.items():
            _refuse(folder, name, before[name], value)
        settings = (record.get("jax_settings", {}) for record in (recorded, jax_settings.record()))
        _refuse(folder, "the settings of jax", *settings)
        _refuse(folder, "the demonstrations", recorded.get("dataset", dataset), dataset)
        for name, version in now_parts["parts"].items():
            before_version = recorded.get("parts", {}).get(name, version)
            _refuse(folder, f"the version of {name}", before_version, version)
        sources.refuse_other_code(folder / "config.json", recorded, now_parts)
        encoder_before = recorded.get("encoder") or encoder
        _refuse(folder, "policy.encoder_weights", encoder_before, encoder or encoder_before)
    known = recorded.get("encoder") if started or config.policy.freeze_encoder else None
    frozen = encoder or known
    extra = (
        {"dataset": dataset, **now_parts}
        | ({"encoder": frozen} if frozen else {})
        | jax_settings.record()
    )
    files.write_json(folder / "config.json", {**config_json.as_json(config), **extra})


def read_config(folder: Path) -> config_lib.RunConfig:
    """Returns the settings of a method's directory."""
    return _settings(folder, _recorded(folder))


def _recorded(folder: Path) -> dict[str, Any]:
    """Returns the content of a method's config.json."""
    path = folder / "config.json"
    if not path.is_file():
        hint = _remedy(folder) if (folder / "policy.safetensors").is_file() else ""
        expected = "a method's folder such as runs/cpu/stardiff"
        raise errors.UsageError(str(folder), expected, "no config.json", hint)
    try:
        content = files.read_json(path)
    except ValueError as error:
        raise errors.UsageError(str(path), "settings", error, _remedy(folder)) from error
    if not content:
        raise errors.UsageError(str(path), "settings", "none", _remedy(folder))
    return content


def _remedy(folder: Path) -> str:
    """Returns the suggested fix for a directory with lost or other settings."""
    weights = folder / "policy.safetensors"
    scores = f"; starjax evaluate --policy {shlex.quote(str(weights))} scores its weights"
    return "train in another folder by --out, or remove this one" + scores * weights.is_file()


def _settings(folder: Path, values: dict[str, Any]) -> config_lib.RunConfig:
    try:
        return config_json.from_dict(config_lib.RunConfig, _without_extra(values))
    except (TypeError, ValueError) as error:
        file = str(folder / "config.json")
        raise errors.UsageError(file, "settings of a run", error, _remedy(folder)) from error


def _without_extra(values: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if name not in _BESIDE}


def _refuse(folder: Path, name: str, before: Any, now: Any) -> None:
    if before != now:
        hint = "choose another folder by --out, or remove that one"
        raise errors.UsageError(name, f"{before}, with which {folder} was made", now, hint)


def demos_digest(root: Path) -> str | None:
    """Returns the digest of a sealed dataset, None without one."""
    try:
        return files.read_json(root / "SEALED.json")["digest"]
    except (FileNotFoundError, KeyError, TypeError, ValueError):
        return None
