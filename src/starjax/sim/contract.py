"""Results that the functions of a `Task` must return, checked while they are traced.

A compiled program is the same with and without the checks. Tasks of other packages are guarded by
`scene.load`; `starjax check` looks at every function by itself.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from starjax.core import errors
from starjax.core.types import Agent, Command, Pose
from starjax.runtime import user_code
from starjax.sim.task import Capsules, Outline, Task, TaskStatus

Fault = tuple[str, str] | None  # expected and got
_SCALARS = {
    "success_now": jnp.bool_,
    "loose": jnp.bool_,
    "lost": jnp.bool_,
    "stage": jnp.integer,
    "reward": jnp.floating,
}


def guarded(task: Task) -> Task:
    """Returns a task whose functions raise one line for an exception or a wrong result.

    Raises:
      errors.UsageError: the record itself is incomplete.
    """
    part = f"task {task.name}"
    _check_record(part, task)
    functions = {
        name: _checked(part, name, getattr(task, name), functools.partial(check, task))
        for name, check in _CHECKS.items()
        if getattr(task, name) is not None
    }
    return task._replace(**functions)


def expert(task: Task, variant: str) -> Agent:
    """Returns a scripted demonstrator of a task, guarded as the task's functions are."""
    part = f"task {task.name}: expert {variant}"
    agent = user_code.guarded(f"task {task.name}", f"expert {variant}", task.expert)(variant)
    if not isinstance(agent, Agent):
        raise errors.UsageError(part, "an Agent", type(agent).__name__)
    act = _checked(part, "act", agent.act, functools.partial(_act, task))
    return Agent(user_code.guarded(part, "init", agent.init), act)


def _checked(
    part: str, name: str, function: Callable[..., Any], check: Callable[..., Fault]
) -> Callable[..., Any]:
    call = user_code.guarded(part, name, function)

    @functools.wraps(function)
    def checked(*args: Any, **options: Any) -> Any:
        result = call(*args, **options)
        if fault := check(args, result):
            raise errors.UsageError(user_code.subject(part, name, function), *fault)
        return result

    return checked


def _check_record(part: str, task: Task) -> None:
    counts = {
        "slots": len(task.slots),
        "cameras": len(task.cameras),
        "fields": len(task.fields),
        "stages": len(task.stages),
        "experts": len(task.experts),
        "settle_steps": task.settle_steps,
    }
    for name, count in counts.items():
        if count < 1:
            raise errors.UsageError(f"{part}: {name}", "1 or more", count)
    if not task.time_limit_s > 0:
        raise errors.UsageError(f"{part}: time_limit_s", "more than 0", task.time_limit_s)
    shapes = [jnp.shape(field) for field in task.trocars]
    expected = (len(task.is_seen), task.arms)
    if set(shapes) != {expected}:
        got = ", ".join(str(list(shape)) for shape in shapes)
        raise errors.UsageError(f"{part}: trocars", f"fields {list(expected)}", got)


def _array(shape: tuple[int, ...], kind: Any, result: Any) -> Fault:
    """Compares a result with an array's shape and kind of number."""
    if not hasattr(result, "dtype"):
        result = jnp.asarray(result) if isinstance(result, bool | int | float) else result
    if not hasattr(result, "shape"):
        return f"an array {list(shape)}", type(result).__name__
    if tuple(result.shape) != shape:
        return f"an array {list(shape)}", f"{list(result.shape)}"
    if not jnp.issubdtype(result.dtype, kind):
        return f"{kind.__name__.rstrip('_')} numbers", str(result.dtype)
    return None


def _same_shape(task: Task, args: tuple[Any, ...], result: Any, index: int) -> Fault:
    return _array(jnp.shape(args[index]), jnp.floating, result)


def _sample(task: Task, args: tuple[Any, ...], result: Any) -> Fault:
    for path, leaf in jax.tree_util.tree_leaves_with_path(result):
        if not hasattr(leaf, "dtype") and not isinstance(leaf, bool | int | float):
            return f"arrays, at {jax.tree_util.keystr(path)} too", type(leaf).__name__
    return None


def _tips(task: Task, args: tuple[Any, ...], result: Any) -> Fault:
    return _array((task.arms, 3), jnp.floating, result)


def _measure(task: Task, args: tuple[Any, ...], result: Any) -> Fault:
    """Compares measurements with those of the step before: a loop carries them."""
    if args[3] is None:
        return None
    before, after = (
        {
            jax.tree_util.keystr(path): (list(jnp.shape(leaf)), str(jnp.result_type(leaf)))
            for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
        }
        for tree in (args[3], result)
    )
    for name in before | after:
        if before.get(name) != after.get(name):
            return f"{name or 'a result'} {_text(before, name)} as at reset", _text(after, name)
    return None


def _text(shapes: dict[str, tuple[list[int], str]], name: str) -> str:
    return "{1} {0}".format(*shapes[name]) if name in shapes else "none"


def _status(task: Task, args: tuple[Any, ...], result: Any) -> Fault:
    if not isinstance(result, TaskStatus):
        return "a TaskStatus", type(result).__name__
    for name, kind in _SCALARS.items():
        if fault := _array((), kind, getattr(result, name)):
            return f"{name}: {fault[0]}", fault[1]
    return None


def _state(task: Task, args: tuple[Any, ...], result: Any) -> Fault:
    if jnp.shape(result) != (task.state_size,):
        fields = " + ".join(f"{field.size} of {field.name}" for field in task.fields)
        return f"[{task.state_size}] numbers: {fields}", str(list(jnp.shape(result)))
    return _array((task.state_size,), jnp.floating, result)


def _relative(task: Task, args: tuple[Any, ...], result: Any) -> Fault:
    leading = jnp.shape(args[0])[:-1]
    if jnp.shape(result)[:-1] != leading:
        return f"an array {[*leading, 'K']}", str(list(jnp.shape(result)))
    return None


def _label(task: Task, args: tuple[Any, ...], result: Any) -> Fault:
    names = list(result) if isinstance(result, dict) else [type(result).__name__]
    if sorted(names) != sorted(task.labels):
        return f"a dict of {', '.join(task.labels) or 'nothing'}", ", ".join(names) or "nothing"
    for name, value in result.items():
        if fault := _array((), jnp.integer, value):
            return f"{name}: {fault[0]}", fault[1]
    return None


def _obstacles(task: Task, args: tuple[Any, ...], result: Any) -> Fault:
    if not isinstance(result, Capsules):
        return "Capsules", type(result).__name__
    count = len(jnp.shape(result.radius)) == 1 and jnp.shape(result.radius)[0]
    for name, shape in {"radius": (count,), "start": (count, 3), "end": (count, 3)}.items():
        if fault := _array(shape, jnp.floating, getattr(result, name)):
            return f"{name}: {fault[0]}", fault[1]
    return None


def _is_sound(task: Task, args: tuple[Any, ...], result: Any) -> Fault:
    return _array((), jnp.bool_, result)


def _still(task: Task, args: tuple[Any, ...], result: Any) -> Fault:
    return _pose((len(jnp.atleast_2d(result.p)),), result) if _is_pose(result) else _no_pose(result)


def _outline(task: Task, args: tuple[Any, ...], result: Any) -> Fault:
    return None if isinstance(result, Outline) else ("an Outline", type(result).__name__)


def _act(task: Task, args: tuple[Any, ...], result: Any) -> Fault:
    if not isinstance(result, tuple) or len(result) != 3:
        count = f" of {len(result)}" if isinstance(result, tuple) else ""
        expected = "a command to execute, the memory, a command to record"
        return expected, f"a {type(result).__name__}{count}"
    for command in (result[0], result[2]):
        if not isinstance(command, Command) or not _is_pose(command.pose):
            return "a Command", type(command).__name__
        fault = _pose((task.arms,), command.pose)
        if fault := fault or _array((task.arms,), jnp.floating, command.gripper):
            return fault
    return None


def _is_pose(result: Any) -> bool:
    return isinstance(result, Pose)


def _no_pose(result: Any) -> Fault:
    return "a Pose", type(result).__name__


def _pose(leading: tuple[int, ...], pose: Pose) -> Fault:
    fault = _array((*leading, 3, 3), jnp.floating, pose.R)
    return fault or _array((*leading, 3), jnp.floating, pose.p)


def _bind(task: Task, args: tuple[Any, ...], result: Any) -> Fault:
    return None


_CHECKS: dict[str, Callable[[Task, Any, Any], Fault]] = {
    "bind": _bind,
    "sample": _sample,
    "tips": _tips,
    "place_objects": functools.partial(_same_shape, index=1),
    "measure": _measure,
    "status": _status,
    "state": _state,
    "relative": _relative,
    "label": _label,
    "colours": functools.partial(_same_shape, index=2),
    "obstacles": _obstacles,
    "is_sound": _is_sound,
    "drive": functools.partial(_same_shape, index=2),
    "still": _still,
    "outline": _outline,
}
