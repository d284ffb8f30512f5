"""`starjax doctor`: checks of machine and installation, with one remedy per fault."""

import importlib.metadata
import itertools
import os
import pathlib
import shutil
import tempfile
from collections.abc import Callable, Sequence
from typing import NamedTuple

from starjax import cli
from starjax.cli import options, presets
from starjax.runtime import files, gpu, locks, xla

DESCRIPTION = """Checks this machine and the installation; suggests one remedy per fault.

The exit code is 1 if there is a fault.

Examples:
  starjax doctor"""
NEEDED_MEMORY = 4e9  # bytes free for the preset `cpu`
NEEDED_DISK = 3e9  # for a run of the preset `cpu`: 2.4 GB


class Finding(NamedTuple):
    """One line of the answer.

    Attributes:
      name: subject of the check.
      value: its state.
      remedy: suggested fix; empty if healthy.
    """

    name: str
    value: str
    remedy: str = ""


def main(argv: Sequence[str]) -> int:
    """Prints every finding; returns 1 if there is a fault."""
    options.parse("doctor", options.NoFlags, argv, DESCRIPTION)
    # The order matters: a wrong XLA flag ends the process as soon as jax starts.
    findings = _shown(packages, xla_flags, storage, folder_locks, memory)
    if any(finding.name in ("packages", "XLA_FLAGS") and finding.remedy for finding in findings):
        print("       checks that start jax are skipped: it would fail")
    else:
        findings += _shown(settings, devices, scene, video)
    faults = sum(bool(finding.remedy) for finding in findings)
    print(f"\n{faults} fault(s)" if faults else "\nno fault found")
    return 1 if faults else 0


def packages() -> list[Finding]:
    """Checks that the versions fit together."""
    versions = xla.versions()
    name, remedy, jax = "packages", "", versions.get("jax", "")
    missing = [part for part in ("jax", "jaxlib", "mujoco", "mujoco-mjx") if part not in versions]
    if missing:
        remedy = f"{', '.join(missing)} not installed: pip install -e . in starjax's folder"
    elif jax != versions["jaxlib"]:
        remedy = f"jax and jaxlib differ: pip install jax=={jax} jaxlib=={jax}"
    else:
        name = "versions"  # jax can start
        if not (0, 10) <= _numbers(jax)[:2] < (0, 12):
            remedy = f"jax {jax} is untested: pip install 'jax>=0.10.2,<0.12'"
    text = "  ".join(f"{part} {version}" for part, version in versions.items())
    return [Finding(name, text, remedy)]


def xla_flags() -> list[Finding]:
    """Checks XLA_FLAGS: the flag that speeds up jaxlib 0.10 makes 0.11 abort."""
    flag = "--xla_cpu_use_fusion_emitters"
    typed = os.environ.get("XLA_FLAGS", "")
    try:
        recent = _numbers(importlib.metadata.version("jaxlib"))[:2] >= (0, 11)
    except importlib.metadata.PackageNotFoundError:  # reported before
        return []
    if recent and flag in typed:
        return [Finding("XLA_FLAGS", typed, f"jaxlib >= 0.11 aborts on {flag}: take it out")]
    on = [word for word in typed.split() if word.partition("=")[0] == flag]
    if not recent and on and on[-1].partition("=")[2].lower() not in ("false", "0"):
        return [Finding("XLA_FLAGS", typed, f"physics is 300 times slower so: set {flag}=false")]
    xla.prepare_xla()
    return [Finding("XLA_FLAGS", os.environ.get("XLA_FLAGS", "") or "(none needed)")]


def settings() -> list[Finding]:
    """Lists settings of jax that commands do not use or record with their results."""
    try:
        from starjax.runtime import jax_settings
    except (ImportError, RuntimeError):  # `devices` says why
        return []
    values = jax_settings.recorded() | dict.fromkeys(jax_settings.fix(), "not used")
    words = (
        f"{name.upper() if name[0] != '-' else name} {value}" for name, value in values.items()
    )
    return [Finding("settings", ", ".join(words) or "jax's own")]


def storage() -> list[Finding]:
    """Checks room and rights in the working folder, the cache and that of programs."""
    programs = os.environ.get("JAX_COMPILATION_CACHE_DIR", "")
    places = [
        ("folder", pathlib.Path.cwd, "another working folder", "--out"),  # it may have been removed
        ("cache", xla.cache_directory, "STARJAX_CACHE", "STARJAX_CACHE"),
    ]
    if "://" not in programs:
        ours = xla.compilation_cache().is_relative_to(xla.cache_directory())
        option = "STARJAX_CACHE" if ours else "JAX_COMPILATION_CACHE_DIR"
        places.append(("programs", xla.compilation_cache, option, option))
    findings = []
    for name, find, elsewhere, option in places:
        try:
            place = find()
            files.require_writable(place)
        except OSError as error:
            findings.append(Finding(name, str(error), f"choose a writable place by {elsewhere}"))
            continue
        free = shutil.disk_usage(place).free
        short = free < NEEDED_DISK
        remedy = f"make {files.size(NEEDED_DISK)} free, or use another disk by {option}"
        findings.append(Finding(name, f"{place}, {files.size(free)} free", remedy if short else ""))
    return findings


def folder_locks() -> list[Finding]:
    """Checks that a run can lock its folder, if the working folder is on its disk."""
    try:
        with (
            tempfile.TemporaryDirectory(prefix=".starjax-", dir=".") as trial,
            locks.hold(pathlib.Path(trial) / "lock") as is_systems,
        ):
            kind = "the file system's" if is_systems else "marker files, without the file system"
    except (FileNotFoundError, PermissionError):  # reported before
        return []
    except (locks.Held, OSError) as error:
        return [Finding("locks", str(error), "choose a folder on another disk by --out")]
    return [Finding("locks", kind)]


def memory() -> list[Finding]:
    """Returns free memory of the host."""
    free = xla.available_bytes()
    value = f"{files.size(free)} free of {files.size(xla.memory_bytes())}"
    remedy = f"close programs: {files.size(NEEDED_MEMORY)} needed"
    return [Finding("memory", value, remedy if free < NEEDED_MEMORY else "")]


def devices() -> list[Finding]:
    """Finds jax's devices, whether a program compiles and runs there, and a GPU left unused."""
    try:
        import jax
        import jax.numpy as jnp
    except (ImportError, RuntimeError) as error:  # the second from jax's check of jaxlib
        return [Finding("jax", _first_line(error), "reinstall jax and jaxlib")]
    try:
        kinds = [device.device_kind for device in jax.devices()]
        total = float(jax.jit(jnp.sum)(jnp.arange(5.0)))
    except (AssertionError, RuntimeError) as error:  # the first for a platform without its plugin
        remedy = "start with JAX_PLATFORMS=cpu, then see to the GPU's driver (nvidia-smi)"
        reason = str(error) or f"no plugin for JAX_PLATFORMS={os.environ.get('JAX_PLATFORMS')}"
        return [Finding("jax", reason.splitlines()[0], remedy)]
    if total != 10.0:
        return [Finding("jax", f"0+1+2+3+4 = {total}", "reinstall jax and jaxlib")]
    value = f"{jax.default_backend()}, {len(kinds)} x {kinds[0]}, {xla.cores()} cores"
    preset = presets.resolve("auto", gpu.is_used())
    taken = f"auto means {preset.preset}: {presets.reason(gpu.is_used())}"
    return [*_unused_gpu(), Finding("jax", value), Finding("preset", taken)]


def _unused_gpu() -> list[Finding]:
    """Reports a GPU that the system shows and jax does not use, though nothing forbids it."""
    if gpu.is_used() or not gpu.is_shown() or gpu.forbidden():
        return []
    if gpu.has_plugin():
        remedy = "update its driver to a version for jax's CUDA (see nvidia-smi)"
    else:
        remedy = "jax cannot use this GPU yet: pip install -e '.[cuda]'"
    return [Finding("GPU", f"shown by the system, not used by jax: {gpu.why_unused()}", remedy)]


def scene() -> list[Finding]:
    """Checks that the MJCF parts exist and compile."""
    try:
        from starjax.sim import scene as model

        made = model.compose(model.name())
    except (ImportError, RuntimeError, OSError, ValueError) as error:
        return [Finding("scene", _first_line(error), "pip install -e . in starjax's folder, anew")]
    return [Finding("scene", f"{made.ngeom} geoms, {made.nq} coordinates")]


def video() -> list[Finding]:
    """Checks that the report can write videos."""
    try:
        import imageio_ffmpeg

        return [Finding("ffmpeg", imageio_ffmpeg.get_ffmpeg_version())]
    except (ImportError, OSError, RuntimeError) as error:
        return [Finding("ffmpeg", _first_line(error), "pip install imageio-ffmpeg")]


def _shown(*checks: Callable[[], list[Finding]]) -> list[Finding]:
    """Runs the checks; prints each finding at once, because the next check may end the process."""
    findings = []
    for finding in itertools.chain.from_iterable(check() for check in checks):
        findings.append(finding)
        print(f"{'FAULT' if finding.remedy else 'ok':6} {finding.name:9} {finding.value}")
        if finding.remedy:
            print(f"       -> {finding.remedy}")
    return findings


def _first_line(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in version.split(".")[:3] if part.isdigit())


if __name__ == "__main__":
    cli.run(main)
