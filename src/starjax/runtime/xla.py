"""XLA settings for this machine, set before jax starts, and properties of the machine.

This module does not import jax.
"""

import contextlib
import hashlib
import importlib
import importlib.metadata
import os
import platform
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

_GROUPS, _GROUPS_OF_THIS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
_FUSION_FLAG = "--xla_cpu_use_fusion_emitters"
_PACKAGES = (
    "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "mujoco", "mujoco-mjx", "numpy", "scipy",
)  # fmt: skip


def prepare_xla() -> None:
    """Sets XLA flags and the persistent compilation cache; call it before the first jax array.

    With jaxlib < 0.11 on CPU, XLA's fusion emitters recompute the kinematic chain and make one
    physics step about 300 times slower, so they are turned off; later versions need no flag, and
    abort on it. Flags that the user has in XLA_FLAGS stay, and win. Compiled programs are kept in
    `cache_directory()`, unless JAX_COMPILATION_CACHE_DIR already names a place; the small ones too,
    which jax alone would not keep: the hundred of them that begin a training take longer to compile
    than the rest to load.
    """
    for name, value in usual_flags().items():
        if name not in (there := flags()):
            os.environ["XLA_FLAGS"] = f"{there} {name}={value}".strip()
            _warn_if_started()
    _set_default("jax_persistent_cache_min_compile_time_secs", 0.0)
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    cache = compilation_cache()
    try:
        cache.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        line = f"starjax: no cache of compiled programs ({error}): every start compiles them again"
        print(line, file=sys.stderr)
        return
    _set_default("jax_compilation_cache_dir", str(cache))


def has_started() -> bool:
    """Returns True if jax has started its backends in this process."""
    bridge = sys.modules.get("jax._src.xla_bridge")
    return getattr(bridge, "backends_are_initialized", lambda: False)()


def _warn_if_started() -> None:
    """Says that jax has read XLA's flags already, as in a notebook that has used it before."""
    if has_started():
        line = "jax had started before: physics on a CPU is 300 times slower; in a new program call"
        print(f"starjax: {line} starjax.runtime.prepare_xla() first", file=sys.stderr)


def usual_flags() -> dict[str, str]:
    """Returns the flags that `prepare_xla` sets with this jaxlib."""
    return {_FUSION_FLAG: "false"} if _jaxlib_version() < (0, 11) else {}


def flags(variable: str = "XLA_FLAGS") -> str:
    """Returns the flags in a variable of the environment, or in the file that it names."""
    text = os.environ.get(variable, "").strip()
    if not text or text.startswith("-"):
        return text
    try:
        return " ".join(Path(text).read_text().split())
    except (OSError, ValueError):  # XLA passes over it
        return ""


def options_without_kinematics() -> dict[str, Any]:
    """Returns options of `jax.jit` for programs on a CPU that simulate nothing.

    They get back the fusion emitters that `prepare_xla` turns off: with them a training step takes
    0.8 to 0.95 times as long. So they are on there also where the user's XLA_FLAGS turn them off.
    """
    return {_FUSION_FLAG.lstrip("-"): True} if _jaxlib_version() < (0, 11) else {}


def cache_directory() -> Path:
    """Returns the folder of caches: STARJAX_CACHE, else the user's cache directory.

    A user without a home gets one in the system's temporary directory.
    """
    if chosen := os.environ.get("STARJAX_CACHE"):
        return Path(chosen).expanduser()
    if base := os.environ.get("XDG_CACHE_HOME"):
        return Path(base) / "starjax"
    try:
        return Path.home() / ".cache" / "starjax"
    except RuntimeError:
        return Path(tempfile.gettempdir()) / f"starjax-{os.getuid()}"


def compilation_cache() -> Path:
    """Returns the folder of compiled programs: JAX_COMPILATION_CACHE_DIR or this machine's."""
    chosen = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    return Path(chosen) if chosen else cache_directory() / "xla" / _machine()


def versions() -> dict[str, str]:
    """Returns versions of Python, starjax and the packages that decide numbers."""
    import starjax

    versions_by_name = {"python": platform.python_version(), "starjax": starjax.__version__}
    for name in _PACKAGES:
        try:
            versions_by_name[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions_by_name


def hardware() -> dict[str, Any]:
    """Returns processor, cores, memory, and jax's devices if jax has been imported."""
    info: dict[str, Any] = {
        "platform": platform.platform(),
        "cpu": _cpuinfo("model name") or platform.processor() or platform.machine(),
        "cores": cores(),
        "memory_gb": round(memory_bytes() / 1e9, 1),
    }
    if jax := sys.modules.get("jax"):
        info["backend"] = jax.default_backend()
        info["devices"] = [device.device_kind for device in jax.devices()]
    return info


def cores() -> int:
    """Returns the number of processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def memory_bytes() -> int:
    """Returns the memory of the machine, or of the container if that is less."""
    return min([_physical_bytes(), *(limit for limit, _ in _limits())])


def available_bytes() -> int:
    """Returns the memory that is free: without swapping, within a container's limit."""
    return min([_free_bytes(), *(max(limit - used, 0) for limit, used in _limits())])


def _physical_bytes() -> int:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def _free_bytes() -> int:
    try:
        with open("/proc/meminfo") as file:
            for line in file:
                if line.startswith("MemAvailable:"):
                    return 1024 * int(line.split()[1])
    except OSError:
        pass
    return _physical_bytes() // 2


def _limits() -> Iterator[tuple[int, int]]:
    """Yields the limit and usage of each control group of this process."""
    try:
        lines = _GROUPS_OF_THIS.read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if not controllers:  # version 2
            root, names = _GROUPS, ("memory.max", "memory.current", "inactive_file")
        elif "memory" in controllers.split(","):
            root = _GROUPS / "memory"
            names = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
        else:
            continue
        place = Path(path.lstrip("/"))
        for group in (place, *place.parents):
            with contextlib.suppress(OSError, ValueError):  # missing, or "max": no limit
                yield _limit(root / group, *names)


def _limit(group: Path, limit: str, usage: str, reclaimed: str) -> tuple[int, int]:
    most, used = (int((group / name).read_text()) for name in (limit, usage))
    stat = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
    return most, used - int(stat.get(reclaimed, 0))  # the kernel drops cached files in need


def _set_default(option: str, value: str | float) -> None:
    """Sets an option of jax by its variable, for children too, unless the user has."""
    if option.upper() in os.environ:
        return
    os.environ[option.upper()] = str(value)
    if "jax" in sys.modules:  # it has read the environment already
        sys.modules["jax"].config.update(option, value)


def _jaxlib_version() -> tuple[int, ...]:
    try:
        version = importlib.metadata.version("jaxlib")
    except importlib.metadata.PackageNotFoundError:
        return (0, 11)
    return tuple(int(part) for part in version.split(".")[:2])


def _machine() -> str:
    # A home directory may be shared by machines whose processors differ: code compiled for one
    # can stop another with an illegal instruction.
    text = f"{platform.machine()} {_cpuinfo('model name')} {_cpuinfo('flags')} {_jaxlib_version()}"
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _cpuinfo(name: str) -> str:
    try:
        with open("/proc/cpuinfo") as file:
            for line in file:
                key, _, value = line.partition(":")
                if key.strip() == name:
                    return value.strip()
    except OSError:
        pass
    return ""
