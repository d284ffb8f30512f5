"""Traced programs on disk: a later process calls them without tracing their functions again.

The key of jax's cache is a program's text, for which Python traces it first. Here the key is a
digest of everything that decides the text: sources, the values in the function's closures, jax's
settings, shapes, the device. A function that `fingerprint` cannot read, or that jax cannot export,
is traced in each process. Like jax's cache, the folder is trusted.
"""

import contextlib
import functools
import gc
import hashlib
import importlib.metadata
import json
import shutil
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
from jax import export

from starjax.runtime import files, fingerprint, notice, package_files, tree_json, xla

KEPT = 4  # folders of other sources, e.g. of other versions in other environments
_FREE = (
    "jax_compilation_cache_dir", "jax_explain_cache_misses", "jax_log_compiles",
    "jax_logging_level",
)  # fmt: skip
_thread = threading.local()
is_used = True  # tests replace functions in modules, which no key sees


# A program from flat arguments to flat results, and the structure of these.
Stored = tuple[export.Exported, Any]


def program(function: Callable[..., Any]) -> Callable[..., Any]:
    """Returns `function` for `jax.jit`: its trace calls the stored program, if there is one.

    It must be called inside `arguments`, which decide its device.
    """

    def traced(*args: Any) -> Any:
        notice.traced()
        with gc_paused():
            stored = _find(function, args)
            if stored is None:
                return function(*args)
            exported, structure = stored
            return jax.tree.unflatten(structure, exported.call(*jax.tree.leaves(args)))

    name = getattr(function, "func", function)
    return functools.wraps(name, updated=())(traced) if hasattr(name, "__name__") else traced


@contextlib.contextmanager
def gc_paused() -> Iterator[None]:
    """Disables Python's garbage collector inside the block.

    Tracing makes a million objects and throws few of them away. Looking through them again and
    again takes a seventh of its time.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


@contextlib.contextmanager
def arguments(args: Any) -> Iterator[None]:
    """Sets the arguments, or their shapes with shardings, of the program called in the block."""
    before = getattr(_thread, "args", None)
    _thread.args = args
    try:
        yield
    finally:
        _thread.args = before


def _find(function: Callable[..., Any], args: Any) -> Stored | None:
    """Returns the program from disk, else traces and stores it; None if that is impossible."""
    folder, device = _folder(), _device(getattr(_thread, "args", None))
    if folder is None or device is None:
        return None
    name = getattr(function, "__qualname__", repr(function))
    try:
        path = folder / _sources(device) / _key(function, args)
        if stored := _read(path):
            return stored
        _explain(f"{name} is traced: not in {folder}")
        return _export(function, args, device.platform, path)
    except Exception as error:  # an error of the function itself is raised again by its trace
        _explain(f"{name} is traced: {error}")
        return None


def _explain(line: str) -> None:
    """Prints a line if jax explains cache misses, too (JAX_EXPLAIN_CACHE_MISSES=1)."""
    if jax.config.jax_explain_cache_misses:
        print(f"starjax: {line}", file=sys.stderr)


def _read(path: Path) -> Stored | None:
    """Returns a stored program, None without one that is whole."""
    try:
        digest, _, content = path.read_bytes().partition(b"\n")
        if hashlib.sha256(content).hexdigest().encode() != digest:
            return None
        result, _, exported = content.partition(b"\n")
        return export.deserialize(bytearray(exported)), tree_json.decode(json.loads(result))
    except Exception:  # no file, or one of another version
        return None


def _export(function: Callable[..., Any], args: Any, platform: str, path: Path) -> Stored:
    leaves, structure = jax.tree.flatten(args)
    results = []

    def flat(*leaves: Any) -> list[Any]:
        result = function(*jax.tree.unflatten(structure, leaves))
        results.append(jax.tree.structure(result))
        return jax.tree.leaves(result)

    shapes = [jax.ShapeDtypeStruct(a.shape, a.dtype, weak_type=a.weak_type) for a in _avals(leaves)]
    # jax has another word for its default platform's compilers: "cuda" for "gpu".
    platforms = None if platform == jax.default_backend() else [platform]
    exported = export.export(jax.jit(flat), platforms=platforms)(*shapes)
    # No permission, or no package flatbuffers: the program runs and is not stored.
    with contextlib.suppress(ImportError, OSError, TypeError, ValueError):
        result = json.dumps(tree_json.encode(results[-1])).encode()
        content = result + b"\n" + bytes(exported.serialize())
        _evict(path.parent)
        digest = hashlib.sha256(content).hexdigest().encode()
        files.write_bytes(path, digest + b"\n" + content)
    return exported, results[-1]


def _evict(folder: Path) -> None:
    """Removes all but the newest folders, to make place for one that is new."""
    if folder.exists() or not folder.parent.exists():
        return
    there = sorted(folder.parent.iterdir(), key=lambda path: path.stat().st_mtime)
    for old in there[: max(len(there) - KEPT + 1, 0)]:
        shutil.rmtree(old, ignore_errors=True)


def _key(function: Callable[..., Any], args: Any) -> str:
    leaves, structure = jax.tree.flatten(args)
    shapes = [(a.shape, str(a.dtype), a.weak_type) for a in _avals(leaves)]
    # The tree of shapes, not its text: nodes may hold constants of any length.
    tree = jax.tree.unflatten(structure, shapes)
    names = sorted(set(jax.config.values) - set(_FREE))
    settings = [(name, str(getattr(jax.config, name, jax.config.values[name]))) for name in names]
    with jax.ensure_compile_time_eval():  # reads arrays of closures inside a trace
        digest, modules = fingerprint.of(function, tree, settings)
    code = package_files.digests(modules)
    return hashlib.sha256(repr((digest, code)).encode()).hexdigest()


def _avals(leaves: list[Any]) -> list[Any]:
    return [jax.typeof(leaf) for leaf in leaves]


def _device(args: Any) -> jax.Device | None:
    """Returns the device that a program runs on with these arguments; None if it is not one."""
    leaves, devices = jax.tree.leaves(args), set()
    if args is None or any(isinstance(x, jax.core.Tracer) for x in leaves):
        return None
    for leaf in leaves:
        if getattr(leaf, "committed", True) and (sharding := getattr(leaf, "sharding", None)):
            devices |= sharding.device_set
    default = jax.config.jax_default_device or jax.local_devices()[0]
    (device, *others) = devices or {default}
    return device if not others and isinstance(device, jax.Device) else None


def _folder() -> Path | None:
    """Returns the folder, inside that of jax's compiled programs; None if jax keeps no programs."""
    place = jax.config.jax_compilation_cache_dir
    if not (is_used and place and jax.config.jax_enable_compilation_cache):
        return None
    return Path(place) / "programs"


def are_cached() -> bool:
    """Returns whether programs of this version were stored on this machine and device before."""
    folder = _folder()
    try:
        return folder is not None and (folder / _sources(jax.local_devices()[0])).exists()
    except package_files.Missing:  # parts of a script, of which no programs are stored
        return False


@functools.lru_cache(maxsize=8)
def _sources(device: jax.Device) -> str:
    """Returns the digest of all that every program on a device depends on."""
    packages = sorted((d.name, d.version) for d in importlib.metadata.distributions())
    kind = jax.default_backend(), device.platform, device.device_kind
    about = *kind, device.client.platform_version
    code = package_files.digests({"starjax", *package_files.providers()})
    text = repr((about, sys.version, xla.flags(), packages, code))
    return hashlib.sha256(text.encode()).hexdigest()[:16]
