"""Checks of a policy of another package: its scene, its plans, whether calls are independent."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from starjax.deploy import external, served
from starjax.policies.external import POLICIES
from starjax.testing.base import FAILED, NOTE, Check, attempt, failed, verdict

FAR = 0.05  # m from the tip to the first command, beyond a step of any tool
MOVED = 0.01  # m, by which the tips of another observation are away
UNIT = 1e-2  # by which a quaternion's length, or a gripper, may be off
TURNED = 1.0  # rad that a first command may turn the tip by
IMAGE, STATE = "observation/image", "observation/state"


class Recorded:
    """A connection that keeps its requests.

    Attributes:
      connection: of the policy.
      requests: in their order.
    """

    def __init__(self, connection: external.LocalConnection) -> None:
        """Wraps a connection."""
        self.connection, self.requests = connection, []
        self.address, self.metadata = connection.address, connection.metadata

    def widen(self, count: int) -> None:
        """Widens the connection."""
        self.connection.widen(count)

    def ask(self, request: dict[str, Any]) -> dict[str, np.ndarray]:
        """Returns the answer of the policy."""
        self.requests.append(request)
        return self.connection.ask(request)


def check(name: str, n: int) -> Iterator[Check]:
    """Yields the checks of a policy in its task; `n` is not used."""
    fault, record = attempt("record", lambda: POLICIES.get(name))
    if not fault:
        yield Check("record", f"{record.description}; {record.observation} of {record.task}")
        fault, made = attempt("make", lambda: external.LocalConnection(name, record))
    if not fault:
        link = Recorded(made)
        fault, policy = attempt("plan", lambda: served.attach(link))
    if fault:
        yield fault
        return
    settings = policy.trained.policy
    yield Check("plan", f"{settings.horizon} commands, {settings.execute} of them executed")
    (request,) = link.requests
    fault, plans = attempt("calls", lambda: _plans(made, request))
    if fault:
        yield fault
        return
    result = verdict("calls", _faults(plans), "the same length with other observations")
    yield result
    if result.status == FAILED:
        return
    first, moved, dark, again = plans
    tips = np.reshape(request[STATE], (-1, 8))
    faults = [*_commanded(first[0].reshape(-1, 8), tips), *_grippers(first)]
    yield verdict("command", faults, "a pose near the tip's")
    if np.array_equal(first, moved) and np.array_equal(first, dark):
        yield failed("input", f"the plan is the same with tips {1e3 * MOVED:g} mm away")
    elif IMAGE in request and np.array_equal(first, dark):
        yield Check("input", "the plan is the same with a black image", NOTE)
    if not np.array_equal(first, again):
        text = "one observation has several plans: draws or memory, which episodes share"
        yield Check("repeatable", text, NOTE)


def _plans(connection: external.LocalConnection, request: dict[str, Any]) -> list[np.ndarray]:
    """Returns plans of an observation, of two others, and of the first again."""
    rng = np.random.default_rng(0)
    moved = {name: _changed(rng, name, value) for name, value in request.items()}
    dark = {**request, IMAGE: np.zeros_like(request[IMAGE])} if IMAGE in request else moved
    return [connection.ask(each)["actions"] for each in (request, moved, dark, request)]


def _changed(rng: np.random.Generator, name: str, value: Any) -> Any:
    """Returns an entry of another observation: tips some mm away, another image."""
    if name == STATE:
        rows = np.array(value).reshape(-1, 8)
        rows[:, :3] += rng.uniform(-MOVED, MOVED, (len(rows), 3))
        return rows.reshape(np.shape(value)).astype(np.float32)
    if name == IMAGE:
        return rng.integers(0, 256, np.shape(value), np.uint8)
    return value


def _commanded(rows: np.ndarray, tips: np.ndarray) -> Iterator[str]:
    """Yields faults of first commands `[A, 8]`, compared with the measured tips `[A, 8]`."""
    away = float(np.linalg.norm(rows[:, :3] - tips[:, :3], axis=-1).max())
    if away > FAR:
        added = float(np.linalg.norm(rows[:, :3], axis=-1).max())
        yield f"{1e3 * away:.0f} mm from the tip" + ": relative to it?" * (added < FAR)
    lengths = np.linalg.norm(rows[:, 3:7], axis=-1)
    if (off := float(np.abs(lengths - 1.0).max())) > UNIT:
        yield f"quaternions of a length that is off by {off:.2g}"
        return
    angle, other = (_largest_turn(q, tips[:, 3:7]) for q in (rows[:, 3:7], _from_wxyz(rows)))
    if angle > TURNED:
        why = f", by {other:.2f} as wxyz: xyzw is expected" * (other < TURNED)
        yield f"the first command turns the tip by {angle:.2f} rad{why}"


def _grippers(plan: np.ndarray) -> Iterator[str]:
    """Yields a fault of the grippers of a plan `[H, 8 A]`."""
    if (largest := float(np.abs(plan[:, 7::8]).max())) > 1.0 + UNIT:
        yield f"a gripper at {largest:.3g}, expected -1 to 1"


def _from_wxyz(rows: np.ndarray) -> np.ndarray:
    return rows[:, [4, 5, 6, 3]]


def _largest_turn(a: np.ndarray, b: np.ndarray) -> float:
    """Returns the largest angle in rad between quaternions `[A, 4]`."""
    return float(2.0 * np.arccos(np.clip(np.abs(np.sum(a * b, -1)), 0.0, 1.0)).max())


def _faults(plans: list[np.ndarray]) -> Iterator[str]:
    shapes = {plan.shape for plan in plans}
    if len(shapes) > 1:
        yield f"lengths differ: {', '.join(str(list(shape)) for shape in sorted(shapes))}"
    if not all(np.isfinite(plan).all() for plan in plans):
        yield "not finite"
