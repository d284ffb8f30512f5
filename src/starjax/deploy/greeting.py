"""Greetings of servers, and the settings of an evaluation in them, all checked."""

import hashlib
from typing import Any, NamedTuple

import numpy as np

from starjax.core import config, config_json, errors, limits, methods
from starjax.core.errors import UsageError
from starjax.data import pose_rows
from starjax.deploy import wire
from starjax.deploy.inputs import InputSpec
from starjax.policies.monitor import record
from starjax.sim import names
from starjax.sim.task import CONTROL_HZ

MAX_CONNECTIONS = 64
_MAX_HORIZON = 1024  # control steps of a plan
_TASK_HINT = "give openpi's server metadata={'scene': {'task': 'peg_transfer'}}"


class Greeting(NamedTuple):
    """Settings of a served policy.

    Attributes:
      spec: shapes of its inputs; None if it takes plain frames, see `plain`.
      scene: names of task, arms, tools and cameras.
      settings: observation, image size and horizons. The horizon of plain frames is a guess.
      execute: commands executed before the next plan; 0: all.
      batch: requests that the server answers together.
      method: key of `methods.SCORED`.
      action_space: of plain frames, `pose` or `rcm4`.
    """

    spec: InputSpec | None
    scene: names.SceneNames
    settings: config.PolicyConfig
    execute: int
    batch: int
    method: str
    action_space: str = "pose"


def read(metadata: Any) -> Greeting:
    """Reads a greeting of `starjax serve`, or a map of openpi's server with a scene.

    Raises:
      UsageError: a value is missing, of another type or out of range.
    """
    if not isinstance(metadata, dict):
        raise UsageError("greeting", "a map", type(metadata).__name__)
    if (hz := metadata.get("control_hz", CONTROL_HZ)) != CONTROL_HZ:
        raise UsageError("greeting.control_hz", f"{CONTROL_HZ:g} Hz", repr(hz)[:80])
    spec = read_spec(metadata) if metadata.get("protocol") == wire.PROTOCOL else None
    values: dict[str, Any] = {"observation": metadata.get("observation", "image"), "obs_horizon": 1}
    values["image_size"] = metadata.get("image_size", 224)  # that of openpi's models
    if spec:
        values = {"observation": "image" if spec.cameras else "state", "obs_horizon": spec.moments}
        values |= {"image_size": spec.image_size} if spec.cameras else {}
    values |= {name: metadata[name] for name in ("horizon", "execute") if name in metadata}
    if spec is None:
        values.pop("horizon", None)  # measured
    try:
        settings = config_json.from_dict(config.PolicyConfig, values)
        limits.check(settings)
    except ValueError as error:
        raise UsageError("greeting", "settings of a policy", str(error)[:200]) from None
    execute = settings.execute if spec or "execute" in metadata else 0
    method = str(metadata.get("method")) if spec else methods.SERVED
    action_space = metadata.get("action_space", "pose")
    errors.choice("greeting.action_space", str(action_space)[:80], pose_rows.ACTIONS)
    return Greeting(
        spec,
        _scene(metadata.get("scene")),
        settings,
        execute,
        _batch(metadata.get("batch", 1)),
        method if method in methods.METHODS else methods.SERVED,
        action_space,
    )


def read_spec(metadata: dict[str, Any]) -> InputSpec:
    """Reads the inputs of a policy of `starjax serve`.

    Raises:
      UsageError: it is another server.
    """
    try:
        fields: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in metadata["asks"].items()
        }
        return InputSpec(**fields)
    except (KeyError, TypeError, AttributeError) as error:
        raise UsageError("address", "a server of starjax", f"another one: {error!r}") from None


def read_monitor(metadata: dict[str, Any], execute: int) -> record.Monitor | None:
    """Reads the runtime monitor of a policy, None without one.

    Args:
      metadata: the greeting.
      execute: commands executed before the next plan.

    Raises:
      UsageError: it is malformed, or was calibrated with other decisions.
    """
    if "monitor" not in metadata:
        return None
    try:
        monitor = record.from_json(metadata["monitor"])
    except (AttributeError, TypeError, ValueError) as error:
        raise UsageError("greeting.monitor", "a runtime monitor", str(error)[:200]) from None
    if monitor.settings.execute != execute:
        got = f"one of {monitor.settings.execute}"
        raise UsageError("greeting.monitor", f"one of {execute} executed commands", got)
    return monitor


def read_timing(metadata: dict[str, Any]) -> tuple[float, int, int]:
    """Reads commands per second, commands per plan and how many of them are executed.

    Raises:
      UsageError: the rate differs from that of all policies, or a length is out of range.
    """
    hz, *lengths = (metadata.get(name) for name in ("control_hz", "horizon", "execute"))
    if hz != CONTROL_HZ:
        raise UsageError("address", f"a policy at {CONTROL_HZ:g} Hz", hz)
    horizon, execute = (n if type(n) is int else 0 for n in lengths)
    if not 1 <= execute <= horizon <= _MAX_HORIZON:
        expected = f"1 <= execute <= horizon <= {_MAX_HORIZON}"
        raise UsageError("address", expected, f"{lengths[1]} and {lengths[0]}")
    return CONTROL_HZ, horizon, execute


def _scene(value: Any) -> names.SceneNames:
    """Completes the names of a greeting's scene with the task's defaults."""
    if not isinstance(value, dict) or not isinstance(value.get("task"), str):
        raise UsageError("greeting.scene.task", "the name of a task", repr(value)[:80], _TASK_HINT)
    rows = {}
    for field in ("arms", "tools", "cameras"):
        row = rows[field] = value.get(field) or []
        if not isinstance(row, list) or not all(isinstance(name, str) for name in row):
            raise UsageError(f"greeting.scene.{field}", "a list of names", repr(row)[:80])
    from starjax.sim import scene  # for an evaluation; a robot has no simulator

    return scene.name(value["task"], rows["arms"], rows["tools"], rows["cameras"])


def _batch(value: Any) -> int:
    if not isinstance(value, int) or value < 1:
        raise UsageError("greeting.batch", "1 or more", repr(value)[:80])
    return min(value, MAX_CONNECTIONS)


def as_json(value: Any) -> Any:
    """Returns JSON values of a greeting; arrays become lists."""
    if isinstance(value, dict):
        return {str(name): as_json(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(part) for part in value]
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return value if isinstance(value, str | int | float | None) else repr(value)


def identity(origin: dict[str, Any]) -> str:
    """Returns the digest of a greeting, that of the policy if it has one."""
    digest = origin["metadata"].get("digest")
    if isinstance(digest, str) and digest:
        return digest
    return hashlib.sha256(repr(sorted(origin.items())).encode()).hexdigest()
