"""A simulated patient side manipulator on CRTK's topics: kinematic, with an endoscope's frame.

Commands are approached at bounded joint speeds, and held after `WATCHDOG_S` without one.
`measured_cp` and `setpoint_cp` are relative to the endoscope, `local/measured_cp` to the remote
centre; a `servo_cp` without a frame is the endoscope's, as on a dVRK.
"""

# pyright: reportArgumentType=false
# Sequences of messages are lists: see `messages`.

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from starjax.addons.robots import crtk, messages, psm
from starjax.addons.robots.bus import Bus
from starjax.core.types import Pose

RATE = 200.0  # Hz
WATCHDOG_S = 0.1
HOME = np.array([0.1, 0.05, 0.13, 0.3, 0.0, 0.0])
SPEED = np.array([2.0, 2.0, 0.3, 4.0, 4.0, 4.0])  # rad/s, m/s
_IDENTITY = crtk.pose_of_arrays(np.eye(3), np.zeros(3))
_TOOL = crtk.Frames(_IDENTITY, _IDENTITY)
_R_VIEW_BASE = Rotation.from_euler("xyz", [2.4, 0.2, 0.4]).as_matrix()
VIEW_BASE = crtk.pose_of_arrays(_R_VIEW_BASE, np.array([0.05, -0.1, 0.12]))


class SimArm:
    """A manipulator that serves its topics.

    Attributes:
      q: `[6]` joints; `goal`: `[6]`, the setpoint. jaw, jaw_goal: rad.
      state: of `operating_state`. p_trocar: `[3]` m in the base frame, published.
      is_frozen: stamps stay. moved: m, the largest step of the setpoint's tip so far.
      commands: received so far.
    """

    def __init__(
        self,
        bus: Bus,
        namespace: str = "/PSM1",
        instrument: psm.Instrument = psm.LARGE_NEEDLE_DRIVER,
        image: np.ndarray | None = None,
        q: np.ndarray = HOME,
    ) -> None:
        self.q, self.goal, self.jaw, self.jaw_goal = q.copy(), q.copy(), 1.0, 1.0
        self.state, self.p_trocar, self.is_frozen = "ENABLED", np.zeros(3), False
        self.moved, self.commands, self._steps = 0.0, 0, 0
        self._bus, self._instrument, self._image = bus, instrument, image
        self._name, self._at = f"{namespace.strip('/')}_base", namespace
        self._tip = crtk.tool_tip(instrument.wrist)
        self._stamp, self._told = messages.stamp(), None
        self._commanded = time.monotonic()
        pose, joints = messages.PoseStamped, messages.JointState
        kinds: dict[str, tuple[Any, str]] = {
            **dict.fromkeys(("local/measured_cp", "measured_cp", "setpoint_cp"), (pose, "default")),
            **dict.fromkeys(("measured_js", "jaw/measured_js"), (joints, "default")),
            "operating_state": (messages.OperatingState, "latched"),
        }
        self._writers = {n: bus.writer(f"{namespace}/{n}", *kind) for n, kind in kinds.items()}
        self._camera = bus.writer("/camera/image_raw", messages.Image, "sensor")
        self._trocar = bus.writer("/trocar", messages.PointStamped, "latched")
        for name, kind in (("servo_cp", pose), ("servo_jp", joints), ("jaw/servo_jp", joints)):
            bus.read(f"{namespace}/{name}", kind)

    def run(self, seconds: float, should_stop: Callable[[], bool] = lambda: False) -> None:
        """Moves and serves in real time."""
        due = time.monotonic()
        for _ in range(round(seconds * RATE)):
            if should_stop():
                break
            self.step()
            due = max(due + 1.0 / RATE, time.monotonic() - 0.05)
            time.sleep(max(due - time.monotonic(), 0.0))

    def step(self) -> None:
        """Takes commands, moves by a period, publishes."""
        for topic in self._bus.poll():
            self._take(topic.removeprefix(f"{self._at}/"), self._bus.newest[topic])
        if time.monotonic() - self._commanded > WATCHDOG_S:
            self.goal = self.q.copy()
        self.q = self.q + np.clip(self.goal - self.q, -SPEED / RATE, SPEED / RATE)
        self.jaw += float(np.clip(self.jaw_goal - self.jaw, -4.0 / RATE, 4.0 / RATE))
        self._publish()
        self._steps += 1

    def _take(self, name: str, message: Any) -> None:
        if name == "jaw/servo_jp":
            self.jaw_goal = float(message.position[0])
            return
        if name == "servo_jp":
            goal = crtk.joints_of(message, psm.JOINTS)
        else:
            tool = crtk.pose_of(message, _TOOL)
            if message.header.frame_id != self._name:
                tool = crtk.compose(crtk.inverse(VIEW_BASE), tool)
            goal = psm.joints_of(crtk.compose(tool, self._tip), self._instrument)
            goal = min((goal, psm.half_turn(goal)), key=lambda q: np.abs(q - self.goal).max())
        tips = (psm.tip_of(q, self._instrument).p for q in (self.goal, goal))
        self.moved = max(self.moved, float(np.linalg.norm(next(tips) - next(tips))))
        self.goal, self._commanded = goal, time.monotonic()
        self.commands += 1

    def _publish(self) -> None:
        if not self.is_frozen:
            self._stamp = messages.stamp()
        local = self._tool(self.q)
        rows = {
            "local/measured_cp": self._pose(local, self._name),
            "measured_cp": self._pose(crtk.compose(VIEW_BASE, local), "ECM"),
            "setpoint_cp": self._pose(crtk.compose(VIEW_BASE, self._tool(self.goal)), "ECM"),
            "measured_js": self._joints(list(psm.JOINTS), self.q.tolist()),
            "jaw/measured_js": self._joints(["jaw"], [self.jaw]),
        }
        for name, message in rows.items():
            self._writers[name].write(message)
        told = (self.state, self.p_trocar.tolist())
        if told != self._told:
            self._told = told
            header = messages.Header(self._stamp, self._name)
            state = messages.OperatingState(header, self.state, True, False)
            self._writers["operating_state"].write(state)
            self._trocar.write(messages.PointStamped(header, messages.Point(*self.p_trocar)))
        if self._image is not None and self._steps % 7 == 0:
            height, width, _ = self._image.shape
            header, data = messages.Header(self._stamp, "camera"), self._image.tobytes()
            self._camera.write(messages.Image(header, height, width, "rgb8", 0, 3 * width, data))

    def _tool(self, q: np.ndarray) -> Pose:
        return crtk.compose(psm.tip_of(q, self._instrument), crtk.inverse(self._tip))

    def _pose(self, pose: Pose, frame: str) -> messages.PoseStamped:
        out = messages.PoseStamped(messages.Header(self._stamp, frame))
        return crtk.fill_pose(out, pose, _TOOL)

    def _joints(self, names: list[str], values: list[float]) -> messages.JointState:
        return messages.JointState(messages.Header(self._stamp, self._name), names, values)
