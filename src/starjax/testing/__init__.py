"""Checks of parts for their authors' own tests: `starjax check` in a line of pytest.

    from starjax import testing

    def test_my_task():
        testing.check_task("my_task")

Each `check_*` takes the name of an installed part or the part itself, and raises an AssertionError
with every fault. `n` is the number of episodes of each expert of a task.
"""

import contextlib
import functools
from collections.abc import Iterator
from typing import Any

from starjax.core import errors
from starjax.testing import kinds
from starjax.testing.base import FAILED

UNDER_TEST = "part_under_test"  # name of a part that has no name of its own


def check_part(kind: str, part: Any, n: int = 16) -> None:
    """Checks a part of a kind, as `starjax check` names kinds.

    Raises:
      AssertionError: the part has faults; one per line.
      errors.UsageError: no part of the name exists, or another package provides the name.
    """
    with _registered(kind, part) as name:
        faults = [check for check in kinds.run(kind, name, n) if check.status == FAILED]
    assert not faults, "\n".join([f"{kind} {name}", *map(str, faults)])


@contextlib.contextmanager
def _registered(kind: str, part: Any) -> Iterator[str]:
    """Yields the name of a part; one that is not installed is registered meanwhile."""
    registry = kinds.kinds()[kind].registry()
    if isinstance(part, str):
        errors.choice(kind, part, kinds.kinds()[kind].names())
        yield part
        return
    if registry is None:
        raise errors.UsageError(kind, "the name of a part", type(part).__name__)
    name = getattr(part, "name", UNDER_TEST)
    rows: Any = registry.built_in  # the rows themselves: the part is taken out again
    before = rows.get(name)
    rows[name] = part
    try:
        yield name
    finally:
        del rows[name]
        rows.update({} if before is None else {name: before})


check_task = functools.partial(check_part, "task")
check_arm = functools.partial(check_part, "arm")
check_tool = functools.partial(check_part, "tool")
check_learner = functools.partial(check_part, "learner")
check_encoder = functools.partial(check_part, "encoder")
check_policy = functools.partial(check_part, "policy")
check_format = functools.partial(check_part, "format")
check_disturbance = functools.partial(check_part, "disturbance")
check_method = functools.partial(check_part, "method")
check_action_space = functools.partial(check_part, "action_space")
check_preset = functools.partial(check_part, "preset")
