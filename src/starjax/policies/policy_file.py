"""The finished policy as one file, policy.safetensors: weights, statistics and settings, no pickle.

The same policy always gives the same bytes. In half precision its parameters are half as large, and
float32 again once they are loaded.
"""

import hashlib
import json
import pathlib
import types
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
import safetensors
import safetensors.numpy

from starjax.core import config, config_json
from starjax.data import normalizer
from starjax.policies.base import Params
from starjax.policies.monitor import record
from starjax.runtime import files
from starjax.sim import names

SCHEMA = 2
_KEY = "starjax"  # one metadata entry: the format does not keep the order of several
_SEPARATOR = "/"
_MONITOR = "monitor"  # prefix of its arrays, and key of its other values
_MONITOR_ARRAYS = ("center", "width")
# Networks in older files, by method: poses succeed more often without them.
_RETIRED = {"stardiff_pose": "turn", "stardiff_pose_told": "turn"}


class Trained(NamedTuple):
    """A trained policy.

    Attributes:
      method: its name, a key of `methods.METHODS`.
      policy: networks and diffusion.
      train: training settings, for the record.
      params: the averaged (EMA) parameters.
      normalizer: fitted to the training demonstrations.
      scene: names of its task, arms and tools, and of the cameras in the order that it reads them.
      p_world_ref: `[A][3]` m, each arm's nominal trocar, None if unknown.
      roll_zero: `[A]` rad, see `rcm.TrocarFrame`.
      demos: settings of its demonstrations, if known; they name the seen trocars.
      preset: the preset of its run, if it was given; for the record.
      packages: versions of the other packages that provide its task, arms, tools or learner.
      monitor: runtime monitor calibrated with these parameters, None without one.
    """

    method: str
    policy: config.PolicyConfig
    train: config.TrainConfig
    params: Params
    normalizer: normalizer.Normalizer
    scene: names.SceneNames
    p_world_ref: tuple[tuple[float, ...], ...] | None
    roll_zero: tuple[float, ...]
    demos: config.DemosConfig | None = None
    preset: str | None = None
    packages: Mapping[str, str] = types.MappingProxyType({})
    monitor: record.Monitor | None = None


def save(path: pathlib.Path | str, trained: Trained, half: bool = False) -> None:
    """Writes the file atomically.

    Args:
      path: of the file.
      trained: the policy.
      half: store floating-point parameters as float16, with a relative error of at most 1/2048,
        or an absolute one of 3e-8 below 6e-5. The normaliser stays float32.

    Raises:
      ValueError: a parameter is not finite, or too large for float16.
      StorageError: the file cannot be written.
    """
    stats = {
        name: {key: value for key, value in vars(part).items() if value is not None}
        for name in ("action", "state")
        if (part := getattr(trained.normalizer, name)) is not None
    }
    arrays = dict(_flatten({"params": trained.params, "normalizer": stats}))
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise ValueError(f"params: expected finite values, got others in {name}")
        if half and name.startswith(f"params{_SEPARATOR}"):
            arrays[name] = _as_half(name, array)
    about = {
        "schema": SCHEMA,
        "method": trained.method,
        "policy": config_json.as_json(trained.policy),
        "train": config_json.as_json(trained.train),
        "scene": trained.scene._asdict(),
        "p_world_ref": _floats(trained.p_world_ref),
        "roll_zero": _floats(trained.roll_zero),
        "demos": None if trained.demos is None else config_json.as_json(trained.demos),
        "preset": trained.preset,
        # Omitted if empty, so files of starjax's own parts keep their bytes.
        **({"packages": dict(trained.packages)} if trained.packages else {}),
    }
    if trained.monitor is not None:
        _check_monitor(trained, pathlib.Path(path))
        values = record.to_json(trained.monitor)
        parts = {name: values.pop(name) for name in _MONITOR_ARRAYS}
        arrays |= dict(_flatten({_MONITOR: parts}))
        about[_MONITOR] = values
    envelope = {"about": about, "sha256": _hash(about, arrays)}
    data = safetensors.numpy.save(arrays, {_KEY: json.dumps(envelope, sort_keys=True)})
    files.write_bytes(pathlib.Path(path), data)


def load(path: pathlib.Path | str) -> Trained:
    """Reads such a file; its floating-point numbers are float32, however they are stored.

    Raises:
      ValueError: it is missing, damaged, or not one of this schema; the message names it.
      OSError: it may not be read.
    """
    path = pathlib.Path(path)
    if not path.is_file():
        raise ValueError(f"policy: expected a file, got {path}")
    open(path, "rb").close()  # safetensors reports an unreadable file as missing
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            if _KEY not in metadata:
                raise ValueError("it does not say which policy it is of")
            envelope = json.loads(metadata[_KEY])
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        about, expected = envelope["about"], envelope["sha256"]
        schema = about["schema"]
    except (
        safetensors.SafetensorError, OSError, ValueError, KeyError, TypeError, RecursionError
    ) as error:  # fmt: skip
        raise ValueError(f"{path}: not a readable starjax policy: {error}") from error
    if schema != SCHEMA:
        raise ValueError(f"{path}: expected schema {SCHEMA}, got {schema!r}; train it again")
    if _hash(about, arrays) != expected:
        raise ValueError(f"{path}: damaged, its content has another sha256")
    separate = _separate_monitor(path)
    try:
        trained = _trained(about, _unflatten(arrays))
        trained = trained._replace(monitor=separate or _monitor(about, arrays))
    except (KeyError, TypeError, ValueError) as error:
        why = f"no {error} in it" if isinstance(error, KeyError) else error
        raise ValueError(f"{path}: made by another version of starjax: {why}") from error
    _check_monitor(trained, monitor_path(path) if separate else path)
    return _without_retired(trained)


def is_policy(path: pathlib.Path | str) -> bool:
    """Returns True if a file has the metadata of `save`; it may still be damaged."""
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            return _KEY in (file.metadata() or {})
    except (safetensors.SafetensorError, OSError):
        return False


def fingerprint(params: Params) -> str:
    """Returns the SHA-256 of parameters and their names."""
    return _hash({}, dict(_flatten(params)))


def monitor_digest(params: Params) -> str:
    """Returns the digest of the parameters that a monitor belongs to.

    They are rounded to float16 first: a file in half precision keeps the monitor.
    """
    with np.errstate(over="ignore"):
        arrays = {
            name: array.astype(np.float16) if np.issubdtype(array.dtype, np.floating) else array
            for name, array in _flatten(params)
        }
    return _hash({}, arrays)


def is_half(params: Params) -> bool:
    """Returns True if float16 stores all parameters exactly."""
    with np.errstate(over="ignore"):
        return all(np.array_equal(x, np.float16(x)) for _, x in _flatten(params))


def _check_monitor(trained: Trained, where: pathlib.Path) -> None:
    """Raises ValueError if the monitor was calibrated with other parameters or decisions."""
    monitor = trained.monitor
    if monitor is None:
        return
    if monitor.digest != (digest := monitor_digest(trained.params)):
        got = f"one of weights {monitor.digest[:8]}"
        raise ValueError(f"{where}: expected a monitor of weights {digest[:8]}, got {got}")
    if monitor.settings.execute != (execute := trained.policy.execute):
        got = f"one of {monitor.settings.execute}"
        raise ValueError(f"{where}: expected a monitor of {execute} executed commands, got {got}")


def monitor_path(path: pathlib.Path) -> pathlib.Path:
    """Returns the file next to a policy's that may hold its monitor instead, as JSON.

    A new monitor then changes neither the weights' file nor its digest.
    """
    return path.with_suffix(".monitor.json")


def _separate_monitor(path: pathlib.Path) -> record.Monitor | None:
    file = monitor_path(path)
    if not file.exists():
        return None
    values = files.read_json(file)
    try:
        return record.from_json(values)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error


def _monitor(about: dict[str, Any], arrays: dict[str, np.ndarray]) -> record.Monitor | None:
    if _MONITOR not in about:
        return None
    parts = {name: arrays[f"{_MONITOR}{_SEPARATOR}{name}"] for name in _MONITOR_ARRAYS}
    return record.from_json({**about[_MONITOR], **parts})


def _trained(about: dict[str, Any], tree: dict[str, Any]) -> Trained:
    """Parses the content of a file; raises KeyError, TypeError or ValueError if it is malformed."""
    stats = {name: normalizer.MinMax(**part) for name, part in tree["normalizer"].items()}
    places, demos, scene = about["p_world_ref"], about.get("demos"), about["scene"]
    return Trained(
        method=about["method"],
        policy=config_json.from_dict(config.PolicyConfig, about["policy"]),
        train=config_json.from_dict(config.TrainConfig, about["train"]),
        params=tree["params"],
        normalizer=normalizer.Normalizer(action=stats["action"], state=stats.get("state")),
        scene=names.SceneNames(
            scene["task"], *(tuple(scene[part]) for part in ("arms", "tools", "cameras"))
        ),
        p_world_ref=None if places is None else tuple(map(tuple, places)),
        roll_zero=tuple(about["roll_zero"]),
        demos=None if demos is None else config_json.from_dict(config.DemosConfig, demos),
        preset=about.get("preset"),
        packages=about.get("packages", {}),
    )


def _without_retired(trained: Trained) -> Trained:
    """Leaves the retired network out. A monitor stays: its scores are of positions alone."""
    if (retired := _RETIRED.get(trained.method)) not in trained.params:
        return trained
    params = {name: part for name, part in trained.params.items() if name != retired}
    monitor = trained.monitor and trained.monitor._replace(digest=monitor_digest(params))
    return trained._replace(params=params, monitor=monitor)


def _floats(values: Any) -> Any:
    """Converts nested sequences of numbers to lists for JSON."""
    return None if values is None else np.asarray(values, np.float64).tolist()


def _flatten(tree: Params, prefix: str = ""):
    """Yields (path, numpy array) for every leaf of nested dicts."""
    for name in sorted(tree):
        value, path = tree[name], f"{prefix}{name}"
        if isinstance(value, dict):
            yield from _flatten(value, path + _SEPARATOR)
        else:
            yield path, np.asarray(value, order="C")  # unlike ascontiguousarray, keeps scalars


def _as_half(name: str, array: np.ndarray) -> np.ndarray:
    """Casts floating-point numbers to float16; returns other arrays unchanged."""
    if not np.issubdtype(array.dtype, np.floating):
        return array
    most, largest = np.finfo(np.float16).max, np.abs(array).max(initial=0)
    if largest > most:
        raise ValueError(
            f"params: expected at most {most:.0f} for float16, got {largest:g} in {name}"
        )
    return array.astype(np.float16)


def _unflatten(arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for path, array in arrays.items():
        *parents, name = path.split(_SEPARATOR)
        node = tree
        for parent in parents:
            node = node.setdefault(parent, {})
        is_number = np.issubdtype(array.dtype, np.floating)
        node[name] = array.astype(np.float32) if is_number else array
    return jax.device_put(tree)


def _hash(about: dict[str, Any], arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256(json.dumps(about, sort_keys=True).encode())
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()
