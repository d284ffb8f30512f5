"""Follows plans command by command: when to ask, which command is next, what to do without one.

Pure arithmetic of control steps, no clock and no network: `Client` gives it both.

    old plan   0 . . . . . . . execute . . . . horizon
    new plan           0 . . . . . . . . execute . . . horizon
                   asked |<ahead>| due

The first commands of the new plan pass while those of the old one are carried out. Where it is
late, more of the old one are, as long as the new one would have `execute` left; then the robot
holds. While it holds, plans do not age: nothing moves that they would have to foresee.
"""

import collections
import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.spatial.transform import Rotation

from starjax import rcm
from starjax.errors import UsageError
from starjax.rcm import arrays
from starjax.types import Command, Pose

MAX_OFF = 1e-4  # m, of a plan's axes from the trocar: the networks' own are 1e-8
_DOWN = np.array([0.0, 0.0, -1.0], np.float32)
_REMEMBERED = 8  # answers whose latency is looked back at
_SPARE = 1  # control steps asked earlier than the slowest of these was


class Limits(NamedTuple):
    """How far a command may be from the one before: for the owner of a robot to choose.

    Attributes:
      move: m, of the tip; 0.15 m/s at 30 Hz.
      turn: rad, of the tool; 3 rad/s at 30 Hz.
    """

    move: float = 0.005
    turn: float = 0.1


LIMITS = Limits()


@dataclasses.dataclass
class Report:
    """Counts of what happened, in control steps unless said otherwise.

    Attributes:
      steps: commands given.
      plans: that were followed.
      missed: plans whose answer was not there when the one before was carried out.
      stretched: commands beyond `execute` of a plan, as the next one was late.
      held: the last command again, as no plan was left; those before the first plan too.
      limited: commands that were nearer than the plan's, as that was farther than `Limits`.
      refused: answers without a plan that can be followed; `fault` is the last one's reason.
      lost: requests whose connection broke, or that were not answered in time.
      overran: control periods that took too long, of `Client.run`.
      latencies: from asking to the answer, of every plan.
    """

    steps: int = 0
    plans: int = 0
    missed: int = 0
    stretched: int = 0
    held: int = 0
    limited: int = 0
    refused: int = 0
    lost: int = 0
    overran: int = 0
    fault: str = ""
    latencies: list[int] = dataclasses.field(default_factory=list)


class PlanExecutor:
    """One robot's plan, and where it is in it.

    Attributes:
      report: what happened so far.
      last: the last command, None before the first.
    """

    def __init__(
        self,
        p_world_trocar: np.ndarray,
        horizon: int,
        execute: int,
        ahead: int | None,
        limits: Limits,
    ) -> None:
        """Compiles its programs.

        Args:
          p_world_trocar: `[*arms, 3]` m.
          horizon, execute: of the policy, in control steps.
          ahead: control steps before the last command is due that the next plan is asked for; None
            for as many as the slowest of the last answers took, and one.
          limits: between two commands.
        """
        most = horizon - execute
        if ahead is not None and not 0 <= ahead <= most:
            raise UsageError("ahead", f"0 to horizon - execute = {most}", ahead)
        for name, value in limits._asdict().items():
            if not 0 < value < np.inf:
                raise UsageError(f"limits.{name}", "more than 0", value)
        self.report, self.last = Report(), None
        self.horizon, self.execute, self._ahead, self._limits = horizon, execute, ahead, limits
        self._p_world_trocar = np.asarray(p_world_trocar, np.float32)
        self._plan: Command | None = None
        self._next: Command | None = None  # the plan that was answered, until the present one ends
        self._index = self._until = 0  # of the plan: its next command, and where it should end
        self._is_asked = self._is_late = False
        self._moved = self._waited = (
            0  # control steps since the last request, without holds and all
        )
        self._latencies: collections.deque[int] = collections.deque(maxlen=_REMEMBERED)
        still = rcm.pose_on_manifold(_DOWN, 0.0, 0.1, self._p_world_trocar)
        still = jax.device_get(_through(jax.device_get(still), self._p_world_trocar))
        self._toward(still, still)
        plan: list[Any] = [np.broadcast_to(x, (horizon, *x.shape)) for x in still]
        _worst(Pose(*plan), self._p_world_trocar)

    @property
    def ahead(self) -> int:
        """Control steps that a plan is asked for before it is due."""
        if self._ahead is not None:
            return self._ahead
        most = self.horizon - self.execute
        return min(most, max(self._latencies, default=most) + _SPARE)

    @property
    def needs_plan(self) -> bool:
        """Whether a plan should be asked for now."""
        is_near = self._plan is None or self._until - self._index <= self.ahead
        return is_near and self._next is None and not self._is_asked

    @property
    def _is_far_enough(self) -> bool:
        """Whether of the plan that is late, no more than `execute` commands would be left."""
        is_beyond = self._index >= self._until
        return is_beyond and self._moved >= self.horizon - self.execute

    def on_request(self) -> None:
        """A plan has been asked for."""
        self._is_asked, self._moved, self._waited = True, 0, 0

    def on_failure(self, fault: str, is_lost: bool = False) -> None:
        """There will be no answer."""
        self._is_asked = False
        self.report.fault = fault
        self.report.lost += is_lost
        self.report.refused += not is_lost

    def on_plan(self, plan: Command) -> None:
        """The plan that was asked for, `[H, *arms]`; what is off the RCM manifold is refused."""
        off, depth, skew = map(float, _worst(plan.pose, self._p_world_trocar))
        if not (off <= MAX_OFF and depth > 0.0 and skew <= 1e-3):
            said = f"{1e3 * off:.3g} mm from the trocar, {1e3 * depth:.3g} mm beyond it"
            return self.on_failure(f"plan: expected one on the RCM manifold, got axes {said}")
        self._is_asked, self._next = False, plan
        self._latencies.append(self._waited)
        self.report.latencies.append(self._waited)

    def begin(self, pose: Pose, gripper: np.ndarray) -> None:
        """Takes the measured pose `[*arms]` as the first to hold, its axis put through the trocar.

        Raises:
          UsageError: that alone would be a jump.
        """
        given: list[Any] = [np.asarray(x, np.float32) for x in pose]
        pose = Pose(*given)
        held = jax.device_get(_through(pose, self._p_world_trocar))
        _, move, turn = jax.device_get(self._toward(pose, held))
        if not (move <= self._limits.move and turn <= self._limits.turn):
            got = f"one that must turn by {turn:.2g} rad"
            raise UsageError("observation.pose", "a tool through the trocar", got)
        opening: Any = np.clip(np.asarray(gripper, np.float32), -1.0, 1.0)
        self.last = Command(held, opening)

    def step(self) -> Command:
        """The next command `[*arms]`."""
        assert self.last is not None
        is_spent = self._plan is None or self._index >= self._until
        if is_spent and self._next is not None:
            self._plan, self._next = self._next, None
            self._index, self._until = self._moved, min(self._moved + self.execute, self.horizon)
            self._is_late = False
            self.report.plans += 1
        elif is_spent and self._plan is not None and not self._is_late:
            self._is_late = True
            self.report.missed += 1
        self.report.steps += 1
        self._waited += 1
        if self._plan is None or self._index >= self.horizon or self._is_far_enough:
            self.report.held += 1
            return self.last
        wanted = jax.tree.map(lambda x: x[self._index], self._plan)
        pose, move, turn = jax.device_get(self._toward(self.last.pose, wanted.pose))
        self.report.limited += bool(move > self._limits.move or turn > self._limits.turn)
        self.report.stretched += self._index >= self._until
        self._index += 1
        self._moved += 1
        self.last = Command(pose, np.clip(wanted.gripper, -1.0, 1.0))
        return self.last

    def _toward(self, last: Pose, wanted: Pose) -> tuple[Pose, jax.Array, jax.Array]:
        return _toward(last, wanted, self._p_world_trocar, *self._limits)


@jax.jit
@arrays.broadcasting
def _toward(
    last: Pose, wanted: Pose, p_world_trocar: jax.Array, max_move: float, max_turn: float
) -> tuple[Pose, jax.Array, jax.Array]:
    """The pose on the RCM manifold that is on the way from `last` to `wanted` `[*arms]`, at most
    the limits away; how far `wanted` is, at most, in m and rad.

    Rotation and depth go straight, so the tip moves across by what the axis turns, at its depth.
    """
    begin, end = (rcm.rot6d_decode(rcm.rot6d_encode(x.R)) for x in (last, wanted))
    here, there = (rcm.insertion_depth(x, p_world_trocar) for x in (last, wanted))
    turn = Rotation.from_matrix(arrays.matmul(begin.mT, end)).as_rotvec()
    angle = arrays.norm(turn)
    across = jnp.maximum(here, there) * arrays.norm(turn[..., :2])  # the roll moves no tip
    move = arrays.norm(jnp.stack([across, there - here], -1))
    share = jnp.minimum(max_move / jnp.maximum(move, 1e-9), max_turn / jnp.maximum(angle, 1e-9))
    share = jnp.minimum(share, 1.0)
    R = arrays.matmul(begin, Rotation.from_rotvec(share[..., None] * turn).as_matrix())
    R = jnp.where((share < 1.0)[..., None, None], R, end)
    pose = rcm.pose_at_depth(R, here + share * (there - here), p_world_trocar)
    return pose, jnp.max(move), jnp.max(angle)


@jax.jit
@arrays.broadcasting
def _through(pose: Pose, p_world_trocar: jax.Array) -> Pose:
    """The pose with its axis through the trocar: the tip stays, see `rcm.project`."""
    turned = rcm.project(pose, p_world_trocar)
    R = rcm.rot6d_decode(rcm.rot6d_encode(turned.R))
    return rcm.pose_at_depth(R, rcm.insertion_depth(turned, p_world_trocar), p_world_trocar)


@jax.jit
@arrays.broadcasting
def _worst(pose: Pose, p_world_trocar: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Measures how bad the worst of the poses `[H, *arms]` is.

    Returns:
      m, the farthest axis from the trocar; m, the least depth; how far the worst matrix is from a
      rotation.
    """
    x, y, z = (pose.R[..., :, i] for i in range(3))
    mirrored = jnp.abs(jnp.cross(x, y) - z).max()
    skew = jnp.maximum(jnp.abs(arrays.matmul(pose.R.mT, pose.R) - jnp.eye(3)).max(), mirrored)
    off = rcm.rcm_error(pose, p_world_trocar).max()
    return off, rcm.insertion_depth(pose, p_world_trocar).min(), skew
