"""Checks of an action space: there and back, on the manifold, and total."""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.core.types import Pose
from starjax.rcm.actions import ACTION_SPACES, ActionSpace
from starjax.runtime import user_code
from starjax.sim import registries
from starjax.testing.base import FAILED, Check, attempt, verdict

COUNT = 256  # poses
WRIST = rcm.LARGE_NEEDLE_DRIVER  # sizes for spaces of wrists
TASK = "peg_transfer"  # task of its trocars and tips
TOLERANCE = 1e-5  # m, rad; float32 a tenth of a metre from the origin
MAX_ERROR = 2e-6  # m from the trocar to the shaft, ten times that of the built-in spaces
LARGE = 1e30  # size of an action that is far out


def check(name: str, n: int) -> Iterator[Check]:
    """Yields the checks of an action space; `n` is not used."""
    fault, space = attempt("record", lambda: ACTION_SPACES.registry.get(name))
    if fault:
        yield fault
        return
    space = space.for_wrist(WRIST) if space.for_wrist else space
    yield verdict("record", _parts(space), f"{', '.join(space.slices)}, {space.dim} numbers")
    pose, trocar = _poses()
    part = f"action space {name}"
    encode = jax.jit(user_code.guarded(part, "encode", space.encode))
    decode = jax.jit(user_code.guarded(part, "decode", space.decode))
    fault, action = attempt("encode", lambda: encode(pose, trocar))
    if not fault:
        fault, decoded = attempt("decode", lambda: decode(action, trocar))
    wrong = fault or verdict("encode, decode", _types(space, action, decoded))
    if wrong.status == FAILED:
        yield wrong
        return
    yield verdict("there and back", _differences(pose, decoded), f"{COUNT} poses as they were")
    key = jax.random.key(1)
    drawn = decode(jax.random.uniform(key, (COUNT, space.dim), minval=-1.0), trocar)
    yield verdict("any action", _unsound(drawn, True), "finite poses with rotations")
    yield verdict("facts", _facts(space, decode, trocar), "of the record")
    if not space.is_free:
        yield verdict("manifold", _misses(space, drawn[0], trocar), "shafts pass the trocar")
    far = decode(jnp.full((COUNT, space.dim), LARGE), trocar)
    lost = decode(jnp.full((COUNT, space.dim), jnp.nan), trocar)
    faults = [*_unsound(far, True), *_unsound(lost, False)]
    yield verdict("total", faults, f"finite at {LARGE:g}; NaN is invalid, and holds")


def _parts(space: ActionSpace) -> Iterator[str]:
    """Yields faults of the slices: together they are the action, each number once."""
    taken = sorted(i for part in space.slices.values() for i in range(*part.indices(space.dim)))
    if taken != list(range(space.dim)):
        yield f"slices: expected 0 to {space.dim - 1}, each once, got {taken}"
    for part in space.turns:
        if part not in space.slices:
            yield f"turns: expected parts of {', '.join(space.slices)}, got {part}"
    sizes = {"R": 6, "p": 3, "depth": 1, "roll": 1, "wrist": 2}
    for part, size in sizes.items():
        if part in space.slices and len(range(*space.slices[part].indices(space.dim))) != size:
            yield f"{part}: expected {size} numbers, got {space.slices[part]}"


def _poses() -> tuple[Pose, rcm.TrocarFrame]:
    """Returns poses `[COUNT]` on the manifold, and the trocars that they pass."""
    (slot,) = registries.tasks.get(TASK).slots
    keys = jax.random.split(jax.random.key(0), 3)
    trocar = rcm.sample_trocar(keys[0], (COUNT,))
    frame = rcm.trocar_frame(trocar, jnp.array(slot.p_world_ref), jnp.zeros(()))
    space = registries.workspaces.get(slot.workspace)
    tips = jax.random.uniform(
        keys[1], (COUNT, 3), minval=jnp.array(space.low), maxval=jnp.array(space.high)
    )
    rolls = jax.random.uniform(keys[2], (COUNT,), minval=space.rolls[0], maxval=space.rolls[1])
    return Pose(rcm.rotation_from_axis_roll(tips - frame.p_world_trocar, rolls), tips), frame


def _facts(
    space: ActionSpace, decode: Callable[..., Any], trocar: rcm.TrocarFrame
) -> Iterator[str]:
    """Yields facts of the record that decoded actions contradict."""
    action = jax.random.uniform(jax.random.key(2), (COUNT, space.dim), minval=-0.1, maxval=0.1)
    (pose, _), (other, _) = decode(action, trocar), decode(action[::-1], trocar)
    if space.is_absolute and (away := float(np.abs(pose.p - other.p[::-1]).max())) > TOLERANCE:
        yield f"is_absolute: another trocar moves the tip of an action by {1e3 * away:.2g} mm"
    if space.is_free and float(np.max(rcm.rcm_error(pose, trocar.p_world_trocar))) <= MAX_ERROR:
        yield "is_free: every shaft passes the trocar"


def _types(space: ActionSpace, action: jax.Array, decoded: Any) -> Iterator[str]:
    if not isinstance(decoded, tuple) or len(decoded) != 2 or not isinstance(decoded[0], Pose):
        yield f"expected a Pose and flags of decode, got {type(decoded).__name__}"
        return
    (R, p), valid = decoded
    expected = {"action": (space.dim,), "R": (3, 3), "p": (3,), "valid": ()}
    for (name, shape), got in zip(expected.items(), (action, R, p, valid)):
        if got.shape != (COUNT, *shape):
            yield f"{name}: expected {[COUNT, *shape]}, got {list(got.shape)}"


def _differences(pose: Pose, decoded: Any) -> Iterator[str]:
    (R, p), valid = decoded
    away = float(np.abs(p - pose.p).max())
    turned = float(np.abs(R - pose.R).max())
    if not away <= TOLERANCE:
        yield f"tips off by up to {1e3 * away:.2g} mm"
    if not turned <= TOLERANCE:
        yield f"rotations off by up to {turned:.2g}"
    if not np.all(valid):
        yield f"{int(np.sum(~np.asarray(valid)))} of {COUNT} are said to be invalid"


def _unsound(decoded: Any, is_valid: bool) -> Iterator[str]:
    (R, p), valid = (jax.tree.map(np.asarray, x) for x in decoded)
    if not (np.isfinite(R).all() and np.isfinite(p).all()):
        yield "not finite"
    elif np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max() > TOLERANCE:
        yield "no rotation"
    if not (valid == is_valid).all():
        yield f"expected valid = {is_valid}"


def _misses(space: ActionSpace, pose: Pose, trocar: rcm.TrocarFrame) -> Iterator[str]:
    if space.for_wrist:
        pose = rcm.shaft_of(WRIST, pose, rcm.angles_through(WRIST, pose, trocar.p_world_trocar))
    error = float(np.max(rcm.rcm_error(pose, trocar.p_world_trocar)))
    if not error <= MAX_ERROR:
        yield f"shafts miss the trocar by up to {1e3 * error:.2g} mm: only a free space may"
