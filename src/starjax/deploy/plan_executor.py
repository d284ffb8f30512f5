"""Executes plans command by command: requests them ahead, stretches late ones, then holds.

It counts control steps and has neither clock nor network; `Client` connects it to both.

    old plan   0 . . . . . . . execute . . . . horizon
    new plan           0 . . . . . . . . execute . . . horizon
               request |<ahead>| due

The first commands of the new plan expire while the old plan is executed. A late plan makes the
robot execute more of the old one, as long as the new one would have `execute` commands left; then
the robot holds. Plans do not age during holds, because nothing moves.
"""

import collections
import dataclasses
from typing import Any, NamedTuple

import jax
import numpy as np

from starjax import rcm
from starjax.core.errors import UsageError
from starjax.core.types import Command, Pose
from starjax.deploy import plan_motion
from starjax.sim.task import CONTROL_HZ

MAX_OFF = 1e-4  # m, from a plan's axes to the trocar: the networks' plans are off by 1e-8
MAX_SKEW = 1e-3  # deviation of a plan's matrices from rotations
_DOWN = np.array([0.0, 0.0, -1.0], np.float32)
_DEPTH = 0.1  # m, of the tool that the programs are compiled with
_REMEMBERED = 8  # latest latencies, whose maximum predicts the next
_SPARE = 1  # control steps of margin over that prediction


class Limits(NamedTuple):
    """Maximum speeds of the commands, for the owner of a robot to choose.

    Attributes:
      speed: m/s, of the tip.
      turn_rate: rad/s, of the tool.
    """

    speed: float = 0.15
    turn_rate: float = 3.0

    @property
    def per_step(self) -> tuple[float, float]:
        """Returns m and rad between consecutive commands."""
        return self.speed / CONTROL_HZ, self.turn_rate / CONTROL_HZ


LIMITS = Limits()


@dataclasses.dataclass
class Report:
    """Counts of a control loop, in control steps unless stated otherwise.

    Attributes:
      steps: commands sent.
      plans: plans executed.
      missed: plans that arrived after the previous plan ended.
      stretched: commands beyond `execute` of a plan, while the next one was late.
      held: repetitions of the last command, for want of a plan; also before the first plan.
      silent: steps without a command, because the arm was in doubt.
      stale: steps with a pose or an image that was too old.
      limited: commands clipped to `Limits`.
      refused: replies without a valid plan.
      fault: reason of the last silence, loss or refusal.
      lost: connections that broke, or replies that timed out.
      overran: periods of the loop that took too long.
      alarms: of the policy's runtime monitor; `alarm` describes the last one.
      latencies: of every plan, from the request to its arrival.
    """

    steps: int = 0
    plans: int = 0
    missed: int = 0
    stretched: int = 0
    held: int = 0
    silent: int = 0
    stale: int = 0
    limited: int = 0
    refused: int = 0
    lost: int = 0
    overran: int = 0
    alarms: int = 0
    fault: str = ""
    alarm: str = ""
    latencies: list[int] = dataclasses.field(default_factory=list)


class PlanExecutor:
    """One robot's present and next plan, and the position in the present one.

    Attributes:
      report: counts so far.
      last: the last command, None before the first.
      p_world_trocar: `[*arms, 3]` m; another one only before `begin`.
    """

    def __init__(
        self,
        p_world_trocar: np.ndarray,
        horizon: int,
        execute: int,
        ahead: int | None,
        limits: Limits,
        wrist: rcm.Wrist | None = None,
    ) -> None:
        """Compiles its programs.

        Args:
          p_world_trocar: `[*arms, 3]` m.
          horizon, execute: of the policy, in control steps.
          ahead: control steps between a request and the end of the present plan; None for the
            largest recent latency plus one.
          limits: of the commands' speeds.
          wrist: of all tools, None for straight ones.
        """
        self._max_ahead = horizon - execute
        if ahead is not None and not 0 <= ahead <= self._max_ahead:
            raise UsageError("ahead", f"0 to horizon - execute = {self._max_ahead}", ahead)
        for name, value in limits._asdict().items():
            if not 0 < value < np.inf:
                raise UsageError(f"limits.{name}", "more than 0", value)
        self.report, self.last = Report(), None
        self.horizon, self.execute, self._ahead, self._limits = horizon, execute, ahead, limits
        self.p_world_trocar = np.asarray(p_world_trocar, np.float32)
        self._plan: Command | None = None
        self._next: Command | None = None  # arrived, waits for the end of the present plan
        # Indices in the present plan: its next command, and the planned end.
        self._index = self._until = 0
        self._is_pending = self._is_late = self._is_stopped = False
        self._is_void = False  # the pending reply is of before `forget`
        self._moved = self._waited = 0  # control steps since the request, without and with holds
        self._latencies: collections.deque[int] = collections.deque(maxlen=_REMEMBERED)
        still = rcm.pose_on_manifold(_DOWN, 0.0, _DEPTH, self.p_world_trocar)
        self._motion = plan_motion.of(wrist)
        still = jax.device_get(self._motion.hold(jax.device_get(still), self.p_world_trocar))
        self._toward(still, still)
        plan: list[Any] = [np.broadcast_to(x, (horizon, *x.shape)) for x in still]
        self._motion.worst(Pose(*plan), self.p_world_trocar)
        self._command(still, np.zeros(0))

    @property
    def ahead(self) -> int:
        """Returns the control steps between a request and the end of the present plan."""
        if self._ahead is not None:
            return self._ahead
        return min(self._max_ahead, max(self._latencies, default=self._max_ahead) + _SPARE)

    @property
    def rest(self) -> np.ndarray:
        """Returns the tips `[K, *arms, 3]` m of the present plan that are still to come."""
        if self._plan is None:
            return np.zeros((0, *self.p_world_trocar.shape), np.float32)
        return np.asarray(self._plan.pose.p)[self._index :]

    @property
    def needs_plan(self) -> bool:
        """Returns True if a plan should be requested now."""
        is_near = self._plan is None or self._until - self._index <= self.ahead
        return not self._is_stopped and is_near and self._next is None and not self._is_pending

    def on_request(self) -> None:
        """Records that a plan has been requested."""
        self._is_pending, self._moved, self._waited = True, 0, 0

    def on_failure(self, fault: str, is_lost: bool = False) -> None:
        """Records that the request brought no plan."""
        self._is_pending = self._is_void = False
        self.report.fault = fault
        self.report.lost += is_lost
        self.report.refused += not is_lost

    def on_alarm(self, alarm: str) -> None:
        """Drops all plans: the robot holds its last command until `resume`."""
        self.report.alarm = alarm
        self.report.alarms += 1
        self._plan = self._next = None
        self._is_stopped = True

    def resume(self) -> None:
        """Allows requests again after an alarm."""
        self._is_stopped = False

    def forget(self) -> None:
        """Drops all plans and the last command: the arm may be elsewhere, `begin` comes next."""
        self._plan = self._next = self.last = None
        self._index = self._until = 0
        self._is_late, self._is_void = False, self._is_pending

    def on_plan(self, plan: Command) -> bool:
        """Stores the requested plan `[H, *arms]`; returns False for one that is not executed."""
        if self._is_void:
            self._is_pending = self._is_void = False
            return False
        off, depth, skew = map(float, self._motion.worst(plan.pose, self.p_world_trocar))
        if not (off <= MAX_OFF and depth > 0.0 and skew <= MAX_SKEW):
            got = f"{1e3 * off:.3g} mm from the trocar, {1e3 * depth:.3g} mm beyond it"
            self.on_failure(f"plan: expected one on the RCM manifold, got axes {got}")
            return False
        self._is_pending, self._next = False, plan
        self._latencies.append(self._waited)
        self.report.latencies.append(self._waited)
        return True

    def begin(self, pose: Pose, gripper: Any) -> Command:
        """Returns the first command to hold: the measured pose `[*arms]`, put through the trocar.

        Raises:
          UsageError: a value is not finite, or that alone would exceed the limits.
        """
        sensors: list[Any] = [np.asarray(x, np.float32) for x in (*pose, gripper)]
        for name, values in zip(("R", "p", "gripper"), sensors, strict=True):
            if not np.isfinite(values).all():
                raise UsageError(f"observation.{name}", "finite values", values.tolist())
        pose, opening = Pose(*sensors[:2]), np.clip(sensors[2], -1.0, 1.0)
        held = jax.device_get(self._motion.hold(pose, self.p_world_trocar))
        _, move, turn = self._toward(pose, held)
        if self._exceeds(move, turn):
            got = f"one that must turn by {turn:.2g} rad"
            raise UsageError("observation.pose", "a tool through the trocar", got)
        self.last = self._command(held, opening)
        return self.last

    def step(self) -> Command:
        """Returns the next command `[*arms]`."""
        assert self.last is not None
        is_spent = self._plan is None or self._index >= self._until
        if is_spent and self._next is not None:
            # 1. Switch. Commands of the new plan that were due since its request are skipped.
            self._plan, self._next = self._next, None
            self._index, self._until = self._moved, min(self._moved + self.execute, self.horizon)
            self._is_late = False
            self.report.plans += 1
        elif is_spent and self._plan is not None and not self._is_late:
            self._is_late = True
            self.report.missed += 1
        self.report.steps += 1
        self._waited += 1
        # 2. Hold: no plan, its end, or a late plan would have fewer than `execute` commands left.
        is_stretched = self._index >= self._until
        is_stale = is_stretched and self._moved >= self._max_ahead
        if self._plan is None or self._index >= self.horizon or is_stale:
            self.report.held += 1
            return self.last
        # 3. Execute; beyond `_until` this stretches the plan.
        target = jax.tree.map(lambda x: x[self._index], self._plan)
        pose, move, turn = self._toward(self.last.pose, target.pose)
        self.report.limited += self._exceeds(move, turn)
        self.report.stretched += is_stretched
        self._index += 1
        self._moved += 1
        self.last = self._command(pose, np.clip(target.gripper, -1.0, 1.0))
        return self.last

    def _toward(self, last: Pose, target: Pose) -> tuple[Pose, np.ndarray, np.ndarray]:
        limits = self._limits.per_step
        return jax.device_get(self._motion.toward(last, target, self.p_world_trocar, *limits))

    def _command(self, pose: Pose, gripper: Any) -> Command:
        return Command(
            pose, gripper, jax.device_get(self._motion.angles(pose, self.p_world_trocar))
        )

    def _exceeds(self, move: np.ndarray, turn: np.ndarray) -> bool:
        # A negated comparison: NaN exceeds the limits.
        max_move, max_turn = self._limits.per_step
        return not (move <= max_move and turn <= max_turn)
