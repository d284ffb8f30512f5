"""Checks of a method: its row against the action space and the methods it shares weights with."""

from collections.abc import Iterator

import jax

from starjax import rcm
from starjax.cli import presets
from starjax.core.methods import METHODS, Method
from starjax.data import normalizer
from starjax.policies import policy
from starjax.runtime import user_code
from starjax.sim import registries, scene, wrists
from starjax.testing.base import NOTE, Check, attempt, verdict

TASKS = ("reach", "peg_transfer_bimanual")  # tasks of one arm and of two
WRISTED = "needle_driver"  # tool of methods that move a wrist
# Fields that training depends on: methods with the same weights have the same.
TRAINED = ("action_space", "sees_trocar", "hierarchical")


def check(name: str, n: int) -> Iterator[Check]:
    """Yields the checks of a method; `n` is not used."""
    fault, row = attempt("record", lambda: METHODS[name])
    if not fault:
        fault, _ = attempt("action space", lambda: rcm.ACTION_SPACES.registry.get(row.action_space))
    if fault:
        yield fault
        return
    yield verdict(
        "record", _fields(name, row), f"{row.label}: {row.action_space}, {_conditioning(row)}"
    )
    yield verdict("weights", _weights(name, row), f"those of {row.weights_of}")
    if row.projects and normalizer.keeps_to_manifold(row._replace(projects=False)):
        yield Check("projects", f"{row.action_space} is on the manifold without it", NOTE)
    for task in TASKS:
        fault, size = attempt(f"policy in {task}", lambda t=task: _size(name, row, t))
        yield fault or Check(f"policy in {task}", f"{size:,} parameters of a small one")


def _conditioning(row: Method) -> str:
    kind = "hierarchical" if row.hierarchical else "one network"
    return f"{kind}, {'sees' if row.sees_trocar else 'without'} the trocar"


def _fields(name: str, row: Method) -> Iterator[str]:
    """Yields fields of another type than the defaults', and a label of another method."""
    for field, default in Method._field_defaults.items():
        if not isinstance(got := getattr(row, field), type(default)):
            yield f"{field}: expected a {type(default).__name__}, got {got!r}"
    for other in METHODS:
        if other != name and METHODS[other].label == row.label:
            yield f"label {row.label} is that of {other}"


def _weights(name: str, row: Method) -> Iterator[str]:
    """Yields faults of the method whose weights a row shares."""
    if row.weights_of not in METHODS:
        yield f"weights_of {row.weights_of} is no method"
        return
    owner = METHODS[row.weights_of]
    if owner.weights_of != row.weights_of:
        yield f"weights_of {row.weights_of}, which has those of {owner.weights_of}"
    for field in TRAINED:
        mine, theirs = getattr(row, field), getattr(owner, field)
        if mine != theirs:
            yield f"{field} {mine}, but {theirs} in {row.weights_of}, whose weights it shares"


def _size(name: str, row: Method, task: str) -> int:
    """Returns the number of parameters of a small policy, or raises UsageError."""
    small = presets.PRESETS["smoke"].policy

    def make() -> int:
        found = registries.tasks.get(task)
        if normalizer.has_wrist(row):
            held = scene.name(task, tools=[WRISTED])
            found = wrists.holding(found, held)
        made = policy.make(row, small, found)
        shapes = jax.eval_shape(made.init, jax.random.key(0))
        return sum(leaf.size for leaf in jax.tree.leaves(shapes))

    return user_code.guarded(f"method {name}", "policy", make)()
