"""The robot's side of `starjax serve`: one command per control step on any network.

>>> with deploy.Client("127.0.0.1:8000", trocar) as client:
...     report = client.run(robot, seconds=20.0)
"""

import collections
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.typing import ArrayLike

from starjax import rcm
from starjax.core.errors import UsageError
from starjax.core.types import Command, Pose
from starjax.deploy import greeting, guard, trocar_inputs, wire
from starjax.deploy.connection import Connection
from starjax.deploy.inputs import RobotObservation
from starjax.deploy.plan_executor import LIMITS, Limits, PlanExecutor, Report
from starjax.deploy.robot import Robot
from starjax.policies.monitor.watch import Watch

TIMEOUT_S = 1.0  # for a reply, and for a connection attempt
WAIT_S = 10.0  # for the first connection


class Client:
    """A robot's control loop, with plans from a server.

    `step` maps measurements to the next command and never blocks. Plans are requested ahead, so
    they usually arrive before the previous plan ends. While a plan is late, the client executes
    more of the old one, then repeats the last command: a pose on the RCM manifold, with the jaws
    unchanged. Before the first plan it holds the measured pose. It reconnects to a lost server.

    If the policy has a runtime monitor, an alarm makes the client hold the last command and request
    no plans until `resume`; `report.alarm` has the score, its value and its threshold.

    Every command is on the RCM manifold of the given trocar, within `limits` of the previous one
    and near the measured arm; no reply can break that. `guard.check` compares every measurement
    with `tolerances`. A doubt about the arm (it does not follow, misses the trocar, or its
    measurements are old) ends the commands until a person calls `restart`. A doubt about the images
    lets the present plan end, then it holds.

    Attributes:
      doubts: of the latest step.
      metadata: the server's greeting, see `server.metadata`.
      control_hz: commands per second.
      p_world_trocar: `[*arms, 3]` m.
      input_spec: shapes of the policy's inputs.
    """

    def __init__(
        self,
        address: str,
        trocar: rcm.Trocar | ArrayLike,
        *,
        key: jax.Array | None = None,
        api_key: str = "",
        ahead: int | None = None,
        limits: Limits = LIMITS,
        tolerances: guard.Tolerances = guard.TOLERANCES,
        clock: Callable[[], float] = time.time,
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
          tolerances: of the doubts about the arm and its images.
          clock: s, that of `Observation.stamp`.
          timeout_s: of a reply; after it the client reconnects.
          wait_s: for the first connection.
          is_watched: hold on an alarm of the policy's runtime monitor.
          connect: makes the connection; simulated ones replace it.

        Raises:
          UsageError: there is no server, it refuses the key, its policy does not keep to the RCM
            manifold, or the trocar is invalid or outside the workspace of the policy's task.
        """
        for name, value in tolerances._asdict().items():
            if not value > 0:
                raise UsageError(f"tolerances.{name}", "more than 0", value)
        self._connection = connect(address, api_key, timeout_s, wait_s)
        try:
            self.metadata = self._connection.metadata
            self.input_spec = spec = greeting.read_spec(self.metadata)
            if not spec.keeps_to_manifold:
                expected = "a policy that keeps to the RCM manifold"
                got = f"one of method {self.metadata.get('method')}"
                raise UsageError("address", expected, got)
            self.control_hz, horizon, execute = greeting.read_timing(self.metadata)
            monitor = greeting.read_monitor(self.metadata, execute) if is_watched else None
            self._watch = Watch(monitor) if monitor else None
            self._place(trocar)
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
        self._tolerances, self._clock, self.doubts = tolerances, clock, []
        self._sent: collections.deque[Pose] = collections.deque(maxlen=guard.WATCHED)
        self._tips: collections.deque[Any] = collections.deque(maxlen=guard.WATCHED)
        self._is_silent = False

    @property
    def report(self) -> Report:
        """Returns the counts so far."""
        return self._executor.report

    @property
    def plan(self) -> np.ndarray:
        """Returns the tips `[K, *arms, 3]` m of the present plan that are still to come."""
        return self._executor.rest

    @property
    def reconnected(self) -> int:
        """Returns the number of reconnections."""
        return self._connection.connections - 1

    def step(self, moment: RobotObservation) -> Command | None:
        """Returns the next command `[*arms]`, None while the arm is in doubt.

        Args:
          moment: present measurements, as of `Robot.measure`.

        Raises:
          UsageError: the arm is in doubt at the first moment.
        """
        executor = self._executor
        if executor.last is None and not self._is_silent:
            self._begin(moment)
        else:
            self.doubts = self._doubts(moment)
            self._moments.append(_bare(moment))
        is_stale = any(doubt.name in guard.STALE for doubt in self.doubts)
        self.report.stale += is_stale
        if arm := [doubt for doubt in self.doubts if doubt.kind == "arm"]:
            self.stop(str(arm[0]))
        self._receive()
        if self._is_silent:
            self.report.silent += 1
            return None
        if executor.needs_plan and self._connection.is_up and not self.doubts:
            self._asked, self._moved = moment, self.report.steps - self.report.held
            self._connection.send(self._request())
            executor.on_request()
            self._receive()
        command = executor.step()
        self._record(moment, command.pose)
        return command

    def stop(self, fault: str) -> None:
        """Ends the commands until `restart`."""
        self.report.fault, self._is_silent = fault, True
        self._forget()

    def restart(
        self, moment: RobotObservation, trocar: rcm.Trocar | ArrayLike | None = None
    ) -> None:
        """Begins anew from the measured pose, once a person has looked at the arm.

        Args:
          moment: present measurements.
          trocar: measured anew; None: as before.

        Raises:
          UsageError: the arm is in doubt, or the trocar invalid.
        """
        if trocar is not None:
            self._place(trocar)
            self._executor.p_world_trocar = self.p_world_trocar
        self._forget()
        self._begin(moment)
        self._is_silent = False
        self.resume()

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
            if (command := self.step(robot.measure())) is not None:
                robot.send(command)
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

    def _place(self, trocar: rcm.Trocar | ArrayLike) -> None:
        spec = self.input_spec
        self._trocar = trocar_inputs.read(trocar, spec)
        p_world_trocar = rcm.trocar_position(self._trocar, spec.p_world_ref)
        self.p_world_trocar = np.asarray(p_world_trocar, np.float32)

    def _begin(self, moment: RobotObservation) -> None:
        """Takes the measured pose as the first to hold; raises UsageError if in doubt."""
        self.doubts = self._doubts(moment)
        if arm := [doubt for doubt in self.doubts if doubt.kind == "arm"]:
            raise UsageError("observation", "an arm without doubt", str(arm[0]))
        first = self._executor.begin(moment.pose, moment.gripper)
        self._record(moment, first.pose)
        self._moments.extend([_bare(moment)] * self.input_spec.moments)

    def _forget(self) -> None:
        self._executor.forget()
        self._sent.clear()
        self._tips.clear()

    def _record(self, moment: RobotObservation, sent: Pose) -> None:
        self._sent.append(sent)
        self._tips.append(moment.pose.p)

    def _doubts(self, moment: RobotObservation) -> list[guard.Doubt]:
        is_straight = self.input_spec.held_wrist is None
        snapshot = guard.Snapshot(
            moment.pose,
            moment.pose if is_straight else moment.shaft,
            moment.stamp,
            moment.image_stamp,
            moment.p_world_trocar,
        )
        now, where = self._clock(), self.p_world_trocar
        return guard.check(snapshot, self._sent, where, now, self._tolerances, self._tips)

    def _receive(self) -> None:
        reply = self._connection.poll()
        if reply is None:
            return
        if reply.value is None:
            return self._executor.on_failure(reply.fault, reply.is_lost)
        try:
            plan = wire.decode_reply(self.input_spec, self._executor.horizon, reply.value)
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
        return wire.encode_request(self.input_spec, observation, self._trocar, key)

    def _next_key(self) -> np.ndarray | None:
        if self._key is None:
            return None
        return np.asarray(jax.random.key_data(jax.random.fold_in(self._key, self._requests)))


def _bare(moment: RobotObservation) -> RobotObservation:
    """Returns the fields that a policy observes."""
    return moment.replace(stamp=None, image_stamp=None, shaft=None, p_world_trocar=None)
