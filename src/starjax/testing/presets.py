"""Checks of a preset: ranges of its settings, and that they go together with every method."""

import dataclasses
from collections.abc import Iterator

from starjax.cli import checks, presets, scenes
from starjax.core import config, config_json, errors, limits
from starjax.core.methods import METHODS, TABLE_II
from starjax.testing.base import NOTE, Check, attempt, verdict


def check(name: str, n: int) -> Iterator[Check]:
    """Yields the checks of a preset; `n` is not used."""
    fault, preset = attempt("record", lambda: presets.PRESETS[name])
    if not fault:
        fault, _ = attempt("ranges", lambda: limits.check(preset))
    if not fault:
        fault, _ = attempt("method", lambda: errors.choice("method", preset.method, METHODS))
    if fault:
        yield fault
        return
    both = [config_json.as_json(config.RunConfig()), config_json.as_json(preset)]
    count = len(config_json.differing_settings(both))
    yield Check("record", f"{count} settings of weights other than the paper's")
    fault, full = attempt("scene", lambda: scenes.resolved(preset))
    yield fault or Check("scene", f"task {full.scene.task}, arms {', '.join(full.scene.arm)}")
    yield verdict("methods", _unfit(preset), f"all {len(TABLE_II)} of Table II")
    fault, again = attempt(
        "settings", lambda: config_json.from_dict(config.RunConfig, config_json.as_json(preset))
    )
    yield fault or verdict(
        "settings", ["another preset"] * (again != preset), "come back from a result"
    )
    if preset.train.warmup_steps >= preset.train.steps:
        yield Check("warm-up", "no step has the whole learning rate", NOTE)


def _unfit(preset: config.RunConfig) -> Iterator[str]:
    """Yields faults of settings that do not go together, with the methods."""
    found: dict[str, list[str]] = {}
    for method in TABLE_II:
        fault, _ = attempt(
            method, lambda m=method: checks.check(dataclasses.replace(preset, method=m))
        )
        if fault:
            found.setdefault(fault.text, []).append(method)
    for text, names in found.items():
        yield text if len(names) == len(TABLE_II) else f"{', '.join(names)}: {text}"
