"""A simulated arm on CRTK's topics, with an endoscope's frame; `Kinematic` follows without contact.

`measured_cp` and `setpoint_cp` are relative to the endoscope, `local/measured_cp` to the base; a
`servo_cp` without a frame is the endoscope's, as on a dVRK. Without a command for `WATCHDOG_S` it
holds. A command that it cannot take is refused, with a warning.
"""

# pyright: reportArgumentType=false
# Sequences of messages are lists: see `messages`.

import time
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from starjax.addons.robots import crtk, messages
from starjax.addons.robots.bus import Bus
from starjax.addons.robots.kinematics import Kinematics
from starjax.core.errors import UsageError
from starjax.core.types import Pose

RATE = 120.0  # Hz
WATCHDOG_S = 0.1
CATCH_UP_S = 0.5  # s that a stalled process makes up for
JAW = crtk.Jaw(closed=-0.25, open=1.0)
SPEED = 2.0  # rad/s
SLIDE_SPEED = 0.3  # m/s
_IDENTITY = crtk.pose_of_arrays(np.eye(3), np.zeros(3))
_TOOL = crtk.Frames(_IDENTITY, _IDENTITY)
_R_VIEW_BASE = Rotation.from_euler("xyz", [2.4, 0.2, 0.4]).as_matrix()
VIEW_BASE = crtk.pose_of_arrays(_R_VIEW_BASE, np.array([0.05, -0.1, 0.12]))


def frame_of(namespace: str) -> str:
    """Returns the name of the base frame of an arm's topics."""
    return f"{namespace.strip('/')}_base"


class ArmBody(Protocol):
    """The moving part of a simulated arm.

    Attributes:
      kinematics: of the arm. q: `[J]` rad or m, measured; gripper: in [-1, 1], measured.
      p_base_trocar: `[3]` m. is_sound: False once its simulation has diverged.
    """

    kinematics: Kinematics
    q: np.ndarray
    gripper: float
    p_base_trocar: np.ndarray
    is_sound: bool

    def hold(self) -> np.ndarray:
        """Returns the joints `[J]` to hold."""
        ...

    def step(self, goal: np.ndarray, gripper: float) -> None:
        """Moves for a period of `RATE` towards joints `[J]` and an opening."""
        ...

    def images(self) -> dict[str, np.ndarray]:
        """Returns new images `[h, w, 3]` uint8 by camera, none between two of them."""
        ...


class Kinematic:
    """An `ArmBody` that approaches its goal at bounded speeds and touches nothing."""

    def __init__(
        self, kinematics: Kinematics, picture: np.ndarray, q: np.ndarray | None = None
    ) -> None:
        """Begins at `q`, by default at home, in front of a camera that sees one picture."""
        self.kinematics, self._picture = kinematics, picture
        self.q = (kinematics.home if q is None else q).astype(np.float64)
        self.gripper, self.p_base_trocar, self.is_sound = 1.0, np.zeros(3), True
        limits = kinematics.limits
        is_slide = np.ptp(limits, axis=1) < 0.5
        self._most = np.where(is_slide, SLIDE_SPEED, SPEED) / RATE
        self._steps = 0

    def hold(self) -> np.ndarray:
        """Returns the present joints."""
        return self.q.copy()

    def step(self, goal: np.ndarray, gripper: float) -> None:
        """Moves towards a goal."""
        self.q = self.q + np.clip(goal - self.q, -self._most, self._most)
        self.gripper += float(np.clip(gripper - self.gripper, -6.0 / RATE, 6.0 / RATE))
        self._steps += 1

    def images(self) -> dict[str, np.ndarray]:
        """Returns the picture at 30 Hz."""
        return {"camera": self._picture} if self._steps % 4 == 0 else {}


class SimArm:
    """An arm that serves its topics.

    Attributes:
      goal: `[J]`, the setpoint; jaw: in [-1, 1]. state: of `operating_state`.
      p_trocar: `[3]` m in the base frame, published. is_frozen: stamps stay.
      moved: m, the largest step of the setpoint's tip so far. commands, holds: received so far.
      clock: s, its own time: it stands while the process does. With `is_clocked` it stamps the
        messages and is published.
    """

    def __init__(
        self, bus: Bus, body: ArmBody, namespace: str = "/PSM1", is_clocked: bool = False
    ) -> None:
        self.body, self.goal, self.jaw = body, body.q.copy(), body.gripper
        self.state, self.p_trocar, self.is_frozen = "ENABLED", body.p_base_trocar, False
        self.moved, self.commands, self.holds, self.clock = 0.0, 0, 0, time.time()
        self._bus, self._at, self._is_clocked = bus, namespace, is_clocked
        self._name = frame_of(namespace)
        wrist = body.kinematics.wrist
        self._tip = _IDENTITY if wrist is None else crtk.tool_tip(wrist)
        self._stamp, self._told = messages.stamp(self.clock), None
        self._commanded = self.clock
        pose, joints, text = messages.PoseStamped, messages.JointState, messages.StringStamped
        kinds: dict[str, tuple[Any, str]] = {
            **dict.fromkeys(("local/measured_cp", "measured_cp", "setpoint_cp"), (pose, "default")),
            **dict.fromkeys(("measured_js", "setpoint_js", "jaw/measured_js"), (joints, "default")),
            **dict.fromkeys(("warning", "error"), (text, "default")),
            "operating_state": (messages.OperatingState, "latched"),
        }
        self._writers = {n: bus.writer(f"{namespace}/{n}", *kind) for n, kind in kinds.items()}
        self._clock = bus.writer("/clock", messages.ClockMessage, "sensor") if is_clocked else None
        self._cameras: dict[str, Any] = {}
        self._trocar = bus.writer("/trocar", messages.PointStamped, "latched")
        for name, kind in (("servo_cp", pose), ("servo_jp", joints), ("jaw/servo_jp", joints)):
            bus.read(f"{namespace}/{name}", kind)
        bus.read(f"{namespace}/hold", messages.Empty)

    def run(self, seconds: float, should_stop: Callable[[], bool] = lambda: False) -> None:
        """Moves and serves, in real time where the computer keeps it."""
        due = time.monotonic()
        for _ in range(round(seconds * RATE)):
            if should_stop():
                break
            self.step()
            due = max(due + 1.0 / RATE, time.monotonic() - CATCH_UP_S)
            time.sleep(max(due - time.monotonic(), 0.0))

    def step(self) -> None:
        """Takes commands, moves by a period, publishes."""
        self.take()
        self.clock = self.clock + 1.0 / RATE if self._is_clocked else time.time()
        if self.clock - self._commanded > WATCHDOG_S:
            self.goal, self._commanded = self.body.hold(), np.inf
        self.body.step(self.goal, self.jaw)
        if not self.body.is_sound:
            self.state = "FAULT"
        self._publish()

    def take(self) -> bool:
        """Takes the commands that have come; returns False without one."""
        fresh = self._bus.poll()
        for topic in fresh:
            try:
                self._take(topic.removeprefix(f"{self._at}/"), self._bus.newest[topic])
            except UsageError as error:
                self.warn(str(error))
        return bool(fresh)

    def warn(self, text: str) -> None:
        """Publishes a warning, as CRTK has it for commands that are refused."""
        header = messages.Header(self._stamp, self._name)
        self._writers["warning"].write(messages.StringStamped(header, text))

    def _take(self, name: str, message: Any) -> None:
        if name == "hold":
            self.goal, self._commanded = self.body.hold(), np.inf
            self.holds += 1
            return
        if name == "jaw/servo_jp":
            self.jaw = crtk.opening_of(message, JAW)
            return
        kinematics = self.body.kinematics
        if name == "servo_jp":
            goal = crtk.joints_of(message, kinematics.names[0])
        else:
            tool = crtk.pose_of(message, _TOOL)
            if message.header.frame_id != self._name:
                tool = crtk.compose(crtk.inverse(VIEW_BASE), tool)
            goal = kinematics.joints_of(crtk.compose(tool, self._tip), self.goal)
        low, high = kinematics.limits.T
        if not ((goal >= low) & (goal <= high)).all():
            raise UsageError(name, "joints within their limits", np.round(goal, 3).tolist())
        tips = (kinematics.tip_of(q).p for q in (self.goal, goal))
        self.moved = max(self.moved, float(np.linalg.norm(next(tips) - next(tips))))
        self.goal, self._commanded = goal, self.clock
        self.commands += 1

    def _publish(self) -> None:
        if not self.is_frozen:
            self._stamp = messages.stamp(self.clock)
        q, names = self.body.q, list(self.body.kinematics.names[0])
        local = self._tool(q)
        angle = crtk.fill_jaw(messages.JointState(), self.body.gripper, JAW).position
        rows = {
            "local/measured_cp": self._pose(local, self._name),
            "measured_cp": self._pose(crtk.compose(VIEW_BASE, local), "ECM"),
            "setpoint_cp": self._pose(crtk.compose(VIEW_BASE, self._tool(self.goal)), "ECM"),
            "measured_js": self._joints(names, q.tolist()),
            "setpoint_js": self._joints(names, self.goal.tolist()),
            "jaw/measured_js": self._joints(["jaw"], list(angle)),
        }
        for name, message in rows.items():
            self._writers[name].write(message)
        told = (self.state, self.p_trocar.tolist())
        header = messages.Header(self._stamp, self._name)
        if told != self._told:
            self._told = told
            state = messages.OperatingState(header, self.state, True, False)
            self._writers["operating_state"].write(state)
            point = messages.Point(*map(float, self.p_trocar))
            self._trocar.write(messages.PointStamped(header, point))
        for name, image in self.body.images().items():
            topic = f"/{name}/image_raw"
            if topic not in self._cameras:
                self._cameras[topic] = self._bus.writer(topic, messages.Image, "sensor")
            height, width, _ = image.shape
            header, data = messages.Header(self._stamp, name), image.tobytes()
            message = messages.Image(header, height, width, "rgb8", 0, 3 * width, data)
            self._cameras[topic].write(message)
        if self._clock is not None:
            self._clock.write(messages.ClockMessage(messages.stamp(self.clock)))

    def _tool(self, q: np.ndarray) -> Pose:
        return crtk.compose(self.body.kinematics.tip_of(q), crtk.inverse(self._tip))

    def _pose(self, pose: Pose, frame: str) -> messages.PoseStamped:
        out = messages.PoseStamped(messages.Header(self._stamp, frame))
        return crtk.fill_pose(out, pose, _TOOL)

    def _joints(self, names: list[str], values: list[float]) -> messages.JointState:
        return messages.JointState(messages.Header(self._stamp, self._name), names, values)
