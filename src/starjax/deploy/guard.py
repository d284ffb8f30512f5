"""Doubts about a robot: the reasons not to command it now, from its measurements alone.

Pure, on numpy: no clock, no transport, no policy. `Client`, `drive` and every robot's node ask it
once per control step. A doubt about the arm is answered by silence, after which the robot's own
hold acts, and by forgetting the last command: a person must let it begin anew from the measured
pose. A doubt about the view (images) lets the present plan end, then holds.
"""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from jax.typing import ArrayLike

from starjax.core.types import Pose

MAX_OFF_TROCAR = 0.003  # m, from the measured shaft to the trocar: beyond, its wall would be pushed
MAX_FOLLOWING = 0.004  # m, from the measured tip to the nearest of the last commands
MAX_AGE_S = 0.2  # age of measurements and images
MAX_MOVED = 0.001  # m, of a measured trocar since the plans began
MAX_FIRST = 0.003  # m, from a robot's setpoint to the first command
MAX_FIRST_TURN = 0.1  # rad, likewise: more is another convention of axes
MAX_FUTURE_S = 0.02  # s, by which stamps may be ahead of the clock
MAX_MISFIT = 0.002  # m, between a measured tip and that of the measured joints
MAX_SKEW = 0.05  # deviation of R'R from the identity, far above rounding and calibration errors
FOLLOWED = 3  # last commands, one of which the arm must be near: 0.1 s of latency
WATCHED = 30  # last commands, of 1 s, some of whose motion the arm must make
MIN_FOLLOWED = 0.1  # share of that motion, which is at least `max_following` / 4
STALE = ("stale pose", "stale image")


class Doubt(NamedTuple):
    """A reason not to move.

    Attributes:
      kind: `arm`: silence until a person restarts; `view`: the present plan ends, then hold.
      name: of the check, a row of the table in docs/use/real-robot.md.
      text: measured value and bound, in one line.
    """

    kind: Literal["arm", "view"]
    name: str
    text: str

    def __str__(self) -> str:
        return f"{self.name}: {self.text}"


class Tolerances(NamedTuple):
    """Tolerances of the checks, for the owner of a robot to choose.

    Attributes:
      max_off_trocar: m, from the measured shaft to the trocar.
      max_following: m, from the measured tip to the nearest of the last three commands.
      max_age_s: s, of measurements and images with a stamp.
      max_moved: m, of a measured trocar.
    """

    max_off_trocar: float = MAX_OFF_TROCAR
    max_following: float = MAX_FOLLOWING
    max_age_s: float = MAX_AGE_S
    max_moved: float = MAX_MOVED


TOLERANCES = Tolerances()


class Snapshot(NamedTuple):
    """Measurements of a robot at one moment; only the pose must not be None.

    Attributes:
      pose: of the tips in the world, `[*arms]`; None: no measurement has come.
      shaft: pose of the shafts, `[*arms]`: that of the tips of straight tools.
      stamp: s, of the oldest measurement.
      image_stamp: s, of the oldest image.
      p_world_trocar: `[*arms, 3]` m, measured now.
      is_ready: False while the robot accepts no commands.
      commanders: other programs that command the robot.
      joints: `[J]` rad or m, and `limits`: `[J, 2]`.
      p_joints: `[*arms, 3]` m, the tips by the joints, in the frame of `pose`.
    """

    pose: Pose | None
    shaft: Pose | None = None
    stamp: float | None = None
    image_stamp: float | None = None
    p_world_trocar: Any = None
    is_ready: bool = True
    commanders: int = 0
    joints: Any = None
    limits: Any = None
    p_joints: Any = None


def check(
    snapshot: Snapshot,
    commands: Sequence[Pose],
    p_world_trocar: ArrayLike,
    now: float,
    tolerances: Tolerances = TOLERANCES,
    tips: Sequence[ArrayLike] = (),
) -> list[Doubt]:
    """Returns all doubts, none if the robot may be commanded.

    Args:
      snapshot: present measurements.
      commands: poses `[*arms]` of the last `WATCHED` commands; none before the first.
      p_world_trocar: `[*arms, 3]` m, the trocar of the plans.
      now: s, by the clock of the stamps.
      tolerances: of the robot.
      tips: `[*arms, 3]` m, measured before each of `commands`; none: a stall goes unnoticed.
    """
    out: list[Doubt] = []

    def doubt(name: str, text: str, kind: Literal["arm", "view"] = "arm") -> None:
        out.append(Doubt(kind, name, text))

    if snapshot.pose is None:
        doubt("pose", "none measured")
        return out
    R, p = (np.asarray(x, np.float64) for x in snapshot.pose)
    if not (np.isfinite(R).all() and np.isfinite(p).all()):
        doubt("pose", "not finite")
        return out
    skew = float(np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max())
    if skew > MAX_SKEW or (np.linalg.det(R) < 0.0).any():
        doubt("pose", f"no rotation, off by {skew:.2g}")
        return out
    stamps: tuple[tuple[str, float | None, Literal["arm", "view"]], ...] = (
        ("stale pose", snapshot.stamp, "arm"),
        ("stale image", snapshot.image_stamp, "view"),
    )
    for name, stamp, kind in stamps:
        if stamp is not None and not -MAX_FUTURE_S <= now - stamp <= tolerances.max_age_s:
            doubt(name, f"{now - stamp:.3g} s old, at most {tolerances.max_age_s:g} s", kind)
    if not snapshot.is_ready:
        doubt("state", "the robot accepts no commands")
    if snapshot.commanders:
        doubt("commander", f"{snapshot.commanders} other")
    if snapshot.shaft is not None:
        off = _most(off_trocar(snapshot.shaft, p_world_trocar))
        if not off <= tolerances.max_off_trocar:
            doubt("trocar", f"{_mm(off)} from the shaft, at most {_mm(tolerances.max_off_trocar)}")
    if snapshot.p_world_trocar is not None:
        moved = _distance(snapshot.p_world_trocar, p_world_trocar)
        if not moved <= tolerances.max_moved:
            doubt("moved trocar", f"by {_mm(moved)}, at most {_mm(tolerances.max_moved)}")
    if commands:
        behind = min(_distance(command.p, p) for command in list(commands)[-FOLLOWED:])
        if not behind <= tolerances.max_following:
            text = f"{_mm(behind)} from the last commands, at most {_mm(tolerances.max_following)}"
            doubt("following", text)
    if tips and len(commands) == len(tips) == WATCHED:
        # Each plan begins at the measured tip, so the commands of a still arm stay near it.
        asked = _extent([command.p for command in commands][:-FOLLOWED])
        made = _extent([*tips, p])
        is_still = (asked >= tolerances.max_following / 4.0) & (made < MIN_FOLLOWED * asked)
        if is_still.any():
            text = f"it moved by {_mm(_most(made[is_still]))} in the last second"
            doubt("stall", f"{text}, its commands by {_mm(_most(asked[is_still]))}")
    if snapshot.joints is not None and snapshot.limits is not None:
        low, high = np.asarray(snapshot.limits, np.float64).T
        beyond = np.flatnonzero(~((snapshot.joints >= low) & (snapshot.joints <= high)))
        if beyond.size:
            doubt("joints", f"joint {beyond[0]} beyond its limits")
    if snapshot.p_joints is not None:
        misfit = _distance(snapshot.p_joints, p)
        if not misfit <= MAX_MISFIT:
            doubt("frames", f"pose and joints disagree by {_mm(misfit)}, at most {_mm(MAX_MISFIT)}")
    return out


def check_first(command: Pose, setpoint: Pose, max_first: float = MAX_FIRST) -> list[Doubt]:
    """Compares the first outgoing command with the robot's setpoint, both as in their messages.

    Both are in the frame that the robot assumes, so this finds a wrong or forgotten frame before
    anything moves, without a calibration.
    """
    far = _distance(command.p, setpoint.p)
    turned = np.swapaxes(np.asarray(command.R, np.float64), -1, -2) @ setpoint.R
    cosine = (np.trace(turned, axis1=-2, axis2=-1) - 1.0) / 2.0
    angle = _most(np.arccos(np.clip(cosine, -1.0, 1.0)))
    texts = [f"{_mm(far)} from the setpoint, at most {_mm(max_first)}"] * (not far <= max_first)
    if not angle <= MAX_FIRST_TURN:
        texts.append(f"turned by {angle:.3g} rad from the setpoint, at most {MAX_FIRST_TURN:g}")
    return [Doubt("arm", "first command", text) for text in texts]


def off_trocar(shaft: Pose, p_world_trocar: ArrayLike) -> np.ndarray:
    """Returns the distances `[...]` m from trocars `[..., 3]` to the axes of shafts."""
    R, p = (np.asarray(x, np.float64) for x in shaft)
    return np.linalg.norm(
        np.cross(np.asarray(p_world_trocar, np.float64) - p, R[..., :, 2]), axis=-1
    )


def _distance(p: ArrayLike, other: ArrayLike) -> float:
    return _most(np.linalg.norm(np.asarray(p, np.float64) - np.asarray(other, np.float64), axis=-1))


def _extent(points: Sequence[ArrayLike]) -> np.ndarray:
    """Returns the diagonals `[*arms]` m of the boxes around points `[*arms, 3]`."""
    return np.linalg.norm(np.ptp(np.asarray(points, np.float64), axis=0), axis=-1)


def _most(values: np.ndarray) -> float:
    return float(np.max(values))  # NaN if any is


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.3g} mm"
