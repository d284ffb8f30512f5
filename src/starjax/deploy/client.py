"""The robot's side of `starjax serve`: one command per control step on any network.

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
from starjax.deploy import greeting, wire
from starjax.deploy.connection import Connection
from starjax.deploy.inputs import InputSpec, RobotObservation, check_trocar
from starjax.deploy.plan_executor import LIMITS, Limits, PlanExecutor, Report
from starjax.errors import UsageError
from starjax.monitor.watch import Watch
from starjax.sim.tasks.base import CONTROL_HZ
from starjax.types import Command

TIMEOUT_S = 1.0  # of a reply, and of a connection attempt
WAIT_S = 10.0  # for the first connection
_MAX_HORIZON = 1024  # control steps of a plan


class Robot(Protocol):
    """A robot that `Client.run` can drive."""

    def measure(self) -> RobotObservation:
        """Measures pose `[*arms]`, gripper `[*arms]`, and image `[h, w, 3]`, images or state."""
        ...

    def send(self, command: Command) -> None:
        """Takes a command `[*arms]`, to be reached by the next one."""
        ...


class Client:
    """A robot's control loop, with plans from a server.

    `step` maps measurements to the next command and never blocks. Plans are requested ahead, so
    they usually arrive before the previous plan ends. While a plan is late, the client executes
    more of the old one, then repeats the last command: a pose on the RCM manifold, with the jaws
    unchanged. Before the first plan it holds the measured pose. It reconnects to a lost server.

    If the policy has a runtime monitor, an alarm makes the client hold the last command and request
    no plans until `resume`; `report.alarm` has the score, its value and its threshold.

    Every command is on the RCM manifold of the given trocar and within `limits` of the previous
    one; no reply can break that.

    Attributes:
      metadata: the server's greeting, see `server.metadata`.
      control_hz: commands per second.
      p_world_trocar: `[*arms, 3]` m.
    """

    def __init__(
        self,
        address: str,
        trocar: Any,
        *,
        key: jax.Array | None = None,
        api_key: str = "",
        ahead: int | None = None,
        limits: Limits = LIMITS,
        timeout_s: float = TIMEOUT_S,
        wait_s: float = WAIT_S,
        is_watched: bool = True,
        connect: Callable[..., Any] = Connection,
    ) -> None:
        """Connects and compiles the programs of `step`.

        Args:
          address: `HOST:PORT`, optionally with `ws://` or `wss://` in front.
          trocar: measured trocars: positions `[*arms, 3]` m in the world, or their parameters,
            fields `[*arms]`.
          key: random key of all inferences; None: the server draws them.
          api_key: of the server.
          ahead: control steps between a request and the end of the present plan; None: the largest
            recent latency plus one.
          limits: of the commands' speeds.
          timeout_s: of a reply; after it the client reconnects.
          wait_s: for the first connection.
          is_watched: hold on an alarm of the policy's runtime monitor.
          connect: makes the connection; simulated ones replace it.

        Raises:
          UsageError: there is no server, it refuses the key, its policy does not keep to the RCM
            manifold, or the trocar is invalid or outside the workspace of the policy's task.
        """
        self._connection = connect(address, api_key, timeout_s, wait_s)
        try:
            self.metadata = self._connection.metadata
            self._input_spec = spec = greeting.read_spec(self.metadata)
            if not spec.keeps_to_manifold:
                expected = "a policy that keeps to the RCM manifold"
                got = f"one of method {self.metadata.get('method')}"
                raise UsageError("address", expected, got)
            self.control_hz, horizon, execute = _read_timing(self.metadata)
            self._trocar = _trocar(trocar, spec)
            p_world_trocar = rcm.trocar_position(self._trocar, spec.p_world_ref)
            self.p_world_trocar = np.asarray(p_world_trocar, np.float32)
            monitor = greeting.read_monitor(self.metadata, execute) if is_watched else None
            self._watch = Watch(monitor) if monitor else None
            self._executor = PlanExecutor(
                self.p_world_trocar, horizon, execute, ahead, limits, spec.held_wrist
            )
        except BaseException:
            self._connection.close()
            raise
        self._asked: RobotObservation | None = None  # measured at the latest request
        self._moved = self._watched = 0  # control steps executed at the latest request, and scored
        self._key, self._requests = key, 0
        self._next_key()  # compiles it
        self._moments: collections.deque[RobotObservation] = collections.deque(maxlen=spec.moments)

    @property
    def report(self) -> Report:
        """Returns the counts so far."""
        return self._executor.report

    @property
    def reconnected(self) -> int:
        """Returns the number of reconnections."""
        return self._connection.connections - 1

    def step(self, moment: RobotObservation) -> Command:
        """Returns the next command `[*arms]`.

        Args:
          moment: present measurements, as of `Robot.measure`.

        Raises:
          UsageError: the first moment's tool does not pass through the trocar.
        """
        executor = self._executor
        if executor.last is None:
            executor.begin(moment.pose, moment.gripper)
            self._moments.extend([moment] * self._input_spec.moments)
        else:
            self._moments.append(moment)
        self._receive()
        if executor.needs_plan and self._connection.is_up:
            self._asked, self._moved = moment, self.report.steps - self.report.held
            self._connection.send(self._request())
            executor.on_request()
            self._receive()
        return executor.step()

    def resume(self) -> None:
        """Begins another episode for the monitor, and continues after its alarm."""
        if self._watch:
            self._watch.reset()
        self._executor.resume()

    def run(
        self, robot: Robot, seconds: float, should_stop: Callable[[], bool] = lambda: False
    ) -> Report:
        """Drives a robot in real time for `seconds`, or until `should_stop()`."""
        period, due = 1.0 / self.control_hz, time.monotonic()
        for _ in range(round(seconds * self.control_hz)):
            if should_stop():
                break
            robot.send(self.step(robot.measure()))
            due += period
            rest = due - time.monotonic()
            if rest < 0:
                self.report.overran += 1
                due -= rest  # lost periods are not made up for: the robot would rush
            time.sleep(max(rest, 0.0))
        return self.report

    def close(self) -> None:
        """Ends the connection."""
        self._connection.close()

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _receive(self) -> None:
        reply = self._connection.poll()
        if reply is None:
            return
        if reply.value is None:
            return self._executor.on_failure(reply.fault, reply.is_lost)
        try:
            plan = wire.decode_reply(self._input_spec, self._executor.horizon, reply.value)
        except UsageError as error:
            return self._executor.on_failure(str(error))
        if self._executor.on_plan(plan) and self._watch:
            steps, self._watched = self._moved - self._watched, self._moved
            p, asked = np.asarray(plan.pose.p), self._asked
            assert asked is not None
            if alarm := self._watch.update(p, asked.pose.p, steps, asked.gripper):
                self._executor.on_alarm(str(alarm))

    def _request(self) -> dict[str, Any]:
        key = self._next_key()
        self._requests += 1
        observation = jax.tree.map(lambda *moments: np.stack(moments), *self._moments)
        return wire.encode_request(self._input_spec, observation, self._trocar, key)

    def _next_key(self) -> np.ndarray | None:
        if self._key is None:
            return None
        return np.asarray(jax.random.key_data(jax.random.fold_in(self._key, self._requests)))


def _read_timing(metadata: dict[str, Any]) -> tuple[float, int, int]:
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


def _trocar(trocar: Any, spec: InputSpec) -> rcm.Trocar:
    """Returns trocars of all arms, given as parameters or as positions `[*arms, 3]` m."""
    arms = spec.arms
    if not isinstance(trocar, rcm.Trocar):
        place = np.asarray(trocar)
        if place.dtype.kind not in "fiu" or place.shape != (*arms, 3):
            expected = f"an rcm.Trocar or positions {[*arms, 3]} in m"
            raise UsageError("trocar", expected, f"{type(trocar).__name__} {list(place.shape)}")
        trocar = rcm.trocar_from_position(np.asarray(place, np.float32), spec.p_world_ref)
    trocar = rcm.check_trocar(rcm.Trocar(*(np.asarray(x, np.float32) for x in trocar)))
    shapes = [np.shape(x) for x in trocar]
    if np.broadcast_shapes(*shapes) not in {(), arms}:
        raise UsageError("trocar", f"fields of shape {list(arms)}", shapes)
    trocar = rcm.Trocar(*(np.broadcast_to(x, arms) for x in trocar))
    check_trocar(spec, trocar)
    return trocar
