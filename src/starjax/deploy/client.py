"""A robot's end of `starjax serve`: a command every control step, whatever the network does.

>>> with deploy.Client("127.0.0.1:8000", trocar) as client:
...     report = client.run(robot, seconds=20.0)
"""

import collections
import time
from collections.abc import Callable
from typing import Any, Protocol

import jax
import numpy as np

from starjax import rcm
from starjax.deploy import wire
from starjax.deploy.connection import Connection
from starjax.deploy.inputs import InputSpec, RobotObservation
from starjax.deploy.plan_executor import LIMITS, Limits, PlanExecutor, Report
from starjax.errors import UsageError
from starjax.types import Command

TIMEOUT_S = 1.0  # for an answer, and for a connection
WAIT_S = 10.0  # for the first one


class Robot(Protocol):
    """A robot, as `Client.run` drives it."""

    def measure(self) -> RobotObservation:
        """This moment: pose `[*arms]`, gripper `[*arms]`, image `[h, w, 3]`, images or state."""
        ...

    def send(self, command: Command) -> None:
        """Takes a command `[*arms]`, to be reached by the next one."""
        ...


class Client:
    """A robot's control loop, with plans from a server.

    `step` takes what is measured and gives the next command; it never waits. The next plan is asked
    for ahead, so that it is there when the one before has been carried out. Where it is late more
    of the old plan is carried out, and then the last command again: a pose on the RCM
    manifold, with the jaws as they were. That is also given before the first plan, for the tool as
    it was measured. A server that is gone is looked for until it is there again.

    Every command is on the RCM manifold of the given trocar, and no farther from the one before
    than `limits`, whatever the server answers.

    Attributes:
      metadata: what the server says of itself, see `server.metadata`.
      control_hz: commands a second.
      p_world_trocar: `[*arms, 3]` m.
    """

    def __init__(
        self,
        address: str,
        trocar: rcm.Trocar,
        *,
        key: jax.Array | None = None,
        api_key: str = "",
        ahead: int | None = None,
        limits: Limits = LIMITS,
        timeout_s: float = TIMEOUT_S,
        wait_s: float = WAIT_S,
        connect: Callable[..., Any] = Connection,
    ) -> None:
        """Connects and compiles what a step needs.

        Args:
          address: `HOST:PORT`, or `ws://` or `wss://` before it.
          trocar: where the trocars are, fields `[*arms]`.
          key: random key of all decisions; None for one drawn by the server for each.
          api_key: of the server.
          ahead: control steps before a plan is due that it is asked for; None for as many as the
            last answers took, and one.
          limits: between two commands.
          timeout_s: until an answer is given up, and the connection made anew.
          wait_s: for the server to be there.
          connect: makes the connection; a program that simulates one gives its own.

        Raises:
          UsageError: there is no server, it refuses the key, its policy does not keep to the RCM
            manifold, or the trocar is none.
        """
        self._connection = connect(address, api_key, timeout_s, wait_s)
        try:
            self.metadata = self._connection.metadata
            self._input_spec = _read_spec(self.metadata)
            self.control_hz = float(self.metadata["control_hz"])
            self._trocar = _trocar(trocar, self._input_spec.arms)
            where = rcm.trocar_position(self._trocar, self._input_spec.p_world_ref)
            self.p_world_trocar = np.asarray(where, np.float32)
            horizon, execute = int(self.metadata["horizon"]), int(self.metadata["execute"])
            self._executor = PlanExecutor(self.p_world_trocar, horizon, execute, ahead, limits)
        except BaseException:
            self._connection.close()
            raise
        self._key, self._asked = key, 0
        self._next_key()
        self._seen: collections.deque[RobotObservation] = collections.deque(
            maxlen=self._input_spec.moments
        )

    @property
    def report(self) -> Report:
        """Counts of what happened so far."""
        return self._executor.report

    @property
    def reconnected(self) -> int:
        """How often the connection was made again."""
        return self._connection.connections - 1

    def step(self, moment: RobotObservation) -> Command:
        """The next command `[*arms]`, of what is measured now.

        Args:
          moment: as `Robot.measure` gives it.

        Raises:
          UsageError: the first moment's tool does not go through the trocar.
        """
        executor = self._executor
        if executor.last is None:
            executor.begin(moment.pose, moment.gripper)
            self._seen.extend([moment] * self._input_spec.moments)
        else:
            self._seen.append(moment)
        self._listen()
        if executor.needs_plan and self._connection.is_up:
            self._connection.send(self._request())
            executor.on_request()
            self._listen()
        return executor.step()

    def run(
        self, robot: Robot, seconds: float, should_stop: Callable[[], bool] = lambda: False
    ) -> Report:
        """Drives a robot in real time for so many seconds, or until `should_stop()`."""
        period, due = 1.0 / self.control_hz, time.monotonic()
        for _ in range(round(seconds * self.control_hz)):
            if should_stop():
                break
            robot.send(self.step(robot.measure()))
            due += period
            rest = due - time.monotonic()
            if rest < 0:
                self.report.overran += 1
                due -= rest  # periods that are lost are not made up for: the robot would rush
            time.sleep(max(rest, 0.0))
        return self.report

    def close(self) -> None:
        """Ends the connection."""
        self._connection.close()

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _listen(self) -> None:
        reply = self._connection.poll()
        if reply is None:
            return
        if reply.value is None:
            return self._executor.on_failure(reply.fault, reply.is_lost)
        try:
            plan = wire.decode_reply(self._input_spec, self._executor.horizon, reply.value)
        except UsageError as error:
            return self._executor.on_failure(str(error))
        self._executor.on_plan(plan)

    def _request(self) -> dict[str, Any]:
        key = self._next_key()
        self._asked += 1
        seen = jax.tree.map(lambda *moments: np.stack(moments), *self._seen)
        return wire.encode_request(self._input_spec, seen, self._trocar, key)

    def _next_key(self) -> np.ndarray | None:
        if self._key is None:
            return None
        return np.asarray(jax.random.key_data(jax.random.fold_in(self._key, self._asked)))


def _read_spec(metadata: dict[str, Any]) -> InputSpec:
    try:
        said: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in metadata["asks"].items()
        }
        spec = InputSpec(**said)
    except (KeyError, TypeError, AttributeError) as error:
        raise UsageError("address", "a server of starjax", f"another one: {error!r}") from None
    if not spec.keeps_to_manifold:
        expected = "a policy that keeps to the RCM manifold"
        raise UsageError("address", expected, f"one of method {metadata.get('method')}")
    return spec


def _trocar(trocar: rcm.Trocar, arms: tuple[int, ...]) -> rcm.Trocar:
    if not isinstance(trocar, rcm.Trocar):
        raise UsageError("trocar", "an rcm.Trocar", type(trocar).__name__)
    trocar = rcm.check_trocar(rcm.Trocar(*(np.asarray(x, np.float32) for x in trocar)))
    shapes = [np.shape(x) for x in trocar]
    if np.broadcast_shapes(*shapes) not in {(), arms}:
        raise UsageError("trocar", f"fields of shape {list(arms)}", shapes)
    return rcm.Trocar(*(np.broadcast_to(x, arms) for x in trocar))
