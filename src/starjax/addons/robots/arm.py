"""A patient side manipulator on CRTK's topics: measurements in, commands out."""

# pyright: reportArgumentType=false
# Sequences of messages are lists: see `messages`.

import time
from typing import Any, NamedTuple

import numpy as np

from starjax.addons.robots import crtk, messages, psm
from starjax.addons.robots.bus import Bus
from starjax.addons.robots.robot_file import VIEW, RobotFile
from starjax.core.errors import UsageError
from starjax.core.types import Command, Pose
from starjax.deploy import guard, images
from starjax.deploy.inputs import RobotObservation

WORLD = "world"  # frame of the policy's world in headers
_IDENTITY = crtk.pose_of_arrays(np.eye(3), np.zeros(3))
_ENCODINGS = {"rgb8": False, "bgr8": True}  # True: blue first


class TopicSource(NamedTuple):
    """A topic that the arm reads.

    Attributes:
      topic: its name. kind: its message. profile: of its reader.
    """

    topic: str
    kind: Any
    profile: str = "default"

    @property
    def name(self) -> str:
        """Returns the message's type as ROS names it."""
        return messages.name_of(self.kind)


class CrtkArm:
    """Topics of one arm, its camera and its trocar; `measure` and `send` as `deploy.Robot`.

    It opens no writer before `send`, so it disturbs no other program until then.

    Attributes:
      sources: name -> topic that it reads.
      sent: commands so far.
    """

    def __init__(self, bus: Bus, file: RobotFile, image_size: int) -> None:
        self.bus, self.file, self.sent = bus, file, 0
        self._size, self._writers = image_size, {}
        self._base_name = "" if file.arm.frame == VIEW else file.arm.frame
        self._tip = crtk.tool_tip(file.instrument.wrist)
        self._q = np.zeros(6)  # joints of the last command
        at = file.arm.namespace
        pose, joints = messages.PoseStamped, messages.JointState
        self.sources = {
            "pose": TopicSource(f"{at}/local/measured_cp", pose),
            "view": TopicSource(f"{at}/measured_cp", pose),
            "setpoint": TopicSource(f"{at}/setpoint_cp", pose),
            "joints": TopicSource(f"{at}/measured_js", joints),
            "jaw": TopicSource(f"{at}/jaw/measured_js", joints),
            "state": TopicSource(f"{at}/operating_state", messages.OperatingState, "latched"),
        }
        for name, camera in file.cameras.items():
            self.sources[f"camera {name}"] = TopicSource(camera.topic, messages.Image, "sensor")
        if file.trocar.topic:
            trocar = TopicSource(file.trocar.topic, messages.PointStamped, "latched")
            self.sources["trocar"] = trocar
        for source in self.sources.values():
            bus.read(*source)

    @property
    def commands(self) -> list[str]:
        """Returns the topics that it writes."""
        at = self.file.arm.namespace
        return [f"{at}/{self.file.arm.command}", f"{at}/jaw/servo_jp"]

    def poll(self) -> list[str]:
        """Reads all topics at once, as of one moment; returns those with a new message."""
        return self.bus.poll()

    def missing(self) -> list[str]:
        """Returns the sources without a message."""
        return [name for name, one in self.sources.items() if one.topic not in self.bus.newest]

    def age(self, name: str, now: float) -> float:
        """Returns s since a source's stamp or its arrival, the earlier one."""
        topic = self.sources[name].topic
        stamp = crtk.stamp_of(self.bus.newest[topic])
        return now - (stamp if stamp > now else min(stamp, self.bus.came[topic]))

    def snapshot(self, now: float) -> guard.Snapshot:
        """Returns all measurements for `guard.check`; without a pose while a source is missing."""
        if self.missing():
            return guard.Snapshot(None)
        observed, q = self.measure(now), self._joints()
        state = self._newest("state")
        tip = crtk.compose(self.file.pose_world_base, psm.tip_of(q, self.file.instrument))
        return guard.Snapshot(
            observed.pose,
            observed.shaft,
            observed.stamp,
            observed.image_stamp,
            observed.p_world_trocar,
            is_ready=crtk.is_ready(state),
            commanders=sum(len(self.bus.writers(topic)) for topic in self.commands),
            joints=q,
            limits=psm.LIMITS,
            p_joints=tip.p,
        )

    def measure(self, now: float | None = None) -> RobotObservation:
        """Returns the newest measurements.

        Raises:
          UsageError: a source is missing, or a message cannot be read.
        """
        if missing := self.missing():
            raise UsageError("robot", "a message of each topic", f"none of {', '.join(missing)}")
        now = time.time() if now is None else now
        ages = [self.age(name, now) for name in ("pose", "joints", "jaw")]
        cameras = [name for name in self.sources if name.startswith("camera ")]
        shown = {name.removeprefix("camera "): self._image(name) for name in cameras}
        base, at = self.file.pose_world_base, self._base_name
        return RobotObservation(
            pose=crtk.pose_of(self._newest("pose"), crtk.Frames(base, self._tip, at)),
            gripper=np.float32(crtk.opening_of(self._newest("jaw"), self.file.jaw)),
            images=shown or None,
            stamp=now - _oldest(ages),
            image_stamp=now - _oldest([self.age(name, now) for name in cameras]) if shown else None,
            shaft=crtk.compose(base, psm.shaft_of(self._joints(), self.file.instrument)),
            p_world_trocar=self._p_world_trocar() if "trocar" in self.sources else None,
        )

    def check_first(self, command: Command) -> list[guard.Doubt]:
        """Compares a command with the robot's setpoint, both in the base frame."""
        tool = crtk.Frames(_IDENTITY, _IDENTITY)
        view_base = crtk.pose_view_base(self._newest("view"), self._newest("pose"))
        setpoint = crtk.pose_of(self._newest("setpoint"), tool)
        if self._newest("setpoint").header.frame_id != self._base_name or not self._base_name:
            setpoint = crtk.compose(crtk.inverse(view_base), setpoint)
        return guard.check_first(self._tool(command), setpoint)

    def send(self, command: Command) -> None:
        """Publishes a command and its jaws."""
        at, stamp = self.file.arm, messages.stamp()
        if not self._writers:
            kinds = messages.JointState if at.command == "servo_jp" else messages.PoseStamped
            for topic, kind in zip(self.commands, (kinds, messages.JointState), strict=True):
                self._writers[topic] = self.bus.writer(topic, kind, "servo")
        arm, jaw = self.commands
        self._writers[arm].write(self.message(command, stamp))
        jaws = messages.JointState(messages.Header(stamp, at.frame), ["jaw"])
        self._writers[jaw].write(crtk.fill_jaw(jaws, float(command.gripper), self.file.jaw))
        self.sent += 1

    def message(self, command: Command, stamp: messages.Time) -> Any:
        """Returns `servo_jp` or `servo_cp` of a command, with the frame in its header."""
        if self.file.arm.command == "servo_jp":
            base = self._tip_in_base(command)
            q = psm.joints_of(base, self.file.instrument)
            near = self._q if self.sent else self._joints()
            self._q = min((q, psm.half_turn(q)), key=lambda x: np.abs(x - near).max())
            names = crtk.names_of(self._newest("joints"), psm.NAMES)
            out = messages.JointState(messages.Header(stamp, self.file.arm.frame))
            return crtk.fill_joints(out, self._q, names)
        base, name = self.file.pose_world_base, self._base_name
        if not name:  # the endoscope at this moment
            view = self._newest("view")
            base = crtk.compose(base, crtk.inverse(crtk.pose_view_base(view, self._newest("pose"))))
            name = view.header.frame_id
        out = messages.PoseStamped(messages.Header(stamp, name))
        return crtk.fill_pose(out, command.pose, crtk.Frames(base, self._tip, name))

    def _tip_in_base(self, command: Command) -> Pose:
        return crtk.compose(crtk.inverse(self.file.pose_world_base), command.pose)

    def _tool(self, command: Command) -> Pose:
        return crtk.compose(self._tip_in_base(command), crtk.inverse(self._tip))

    def _newest(self, name: str) -> Any:
        return self.bus.newest[self.sources[name].topic]

    def _joints(self) -> np.ndarray:
        message = self._newest("joints")
        return crtk.joints_of(message, crtk.names_of(message, psm.NAMES))

    def _p_world_trocar(self) -> np.ndarray:
        message = self._newest("trocar")
        p = np.array([message.point.x, message.point.y, message.point.z])
        if message.header.frame_id == WORLD:
            return p
        if message.header.frame_id != self.file.arm.frame:
            expected, got = f"frame {WORLD} or {self.file.arm.frame}", message.header.frame_id
            raise UsageError("trocar.header.frame_id", expected, got or "none")
        point = crtk.pose_of_arrays(np.eye(3), p)
        return np.asarray(crtk.compose(self.file.pose_world_base, point).p)

    def _image(self, name: str) -> np.ndarray:
        message = self._newest(name)
        if message.encoding not in _ENCODINGS:
            raise UsageError(name, " or ".join(_ENCODINGS), message.encoding)
        rows = np.frombuffer(bytes(message.data), np.uint8)
        if rows.size != message.height * message.step or message.step < 3 * message.width:
            raise UsageError(name, f"{message.height} rows of {message.step} bytes", rows.size)
        rows = rows.reshape(message.height, message.step)[:, : 3 * message.width]
        pixels = rows.reshape(message.height, message.width, 3)
        return images.square(pixels, self._size, bgr=_ENCODINGS[message.encoding])


def _oldest(ages: list[float]) -> float:
    """Returns the largest age, or a negative one: a stamp of the future is of another clock."""
    return min(ages) if min(ages) < -guard.MAX_FUTURE_S else max(ages)
