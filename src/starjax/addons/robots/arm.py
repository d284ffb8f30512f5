"""An arm on CRTK's topics: measurements in, commands out.

A patient side manipulator measures its pose itself; that of other arms follows from their joints.
"""

# pyright: reportArgumentType=false
# Sequences of messages are lists: see `messages`.

import io
import time
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from starjax.addons.robots import crtk, kinematics, messages
from starjax.addons.robots.bus import Bus
from starjax.addons.robots.robot_file import VIEW, RobotFile
from starjax.core.errors import UsageError
from starjax.core.types import Command, Pose
from starjax.deploy import guard, images
from starjax.deploy.inputs import RobotObservation

WORLD = "world"  # frame of the policy's world in headers
_IDENTITY = crtk.pose_of_arrays(np.eye(3), np.zeros(3))
_ENCODINGS = {"rgb8": False, "bgr8": True}  # True: blue first
_REPORTS = ("warning", "error")
_MEASURED = ("pose", "joints", "jaw")
REFRESH_S = 3.0  # s, the longest wait for new measurements; then they are stale
MAX_JOINT_STEP = 0.2  # rad and m between two commands: more is another branch of the kinematics


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
    """Topics of one arm, its cameras and its trocar; `measure` and `send` as `deploy.Robot`.

    It opens no writer before `send`, so it disturbs no other program until then.

    Attributes:
      kinematics: of the arm. sources: name -> topic that it reads.
      sent: commands so far.
    """

    def __init__(self, bus: Bus, file: RobotFile, image_size: int) -> None:
        self.bus, self.file, self.sent = bus, file, 0
        arm = file.arm
        self.kinematics = kinematics.of(arm.kind, arm.instrument, arm.task)
        self._is_psm = arm.kind == kinematics.PSM
        self._size, self._writers = image_size, {}
        self._base_name = "" if arm.frame == VIEW else arm.frame
        wrist = self.kinematics.wrist
        self._tip = _IDENTITY if wrist is None else crtk.tool_tip(wrist)
        self._q: np.ndarray | None = None  # joints of the last command
        pose, joints = messages.PoseStamped, messages.JointState
        kinds = {"joints": joints, "jaw": joints, "state": messages.OperatingState}
        if self._is_psm:
            kinds |= dict.fromkeys(("pose", "view", "setpoint"), pose)
        else:
            kinds |= {"joint_setpoint": joints}
        profiles = {"state": "latched"}
        self.sources = {
            name: TopicSource(file.topic(name), kind, profiles.get(name, "default"))
            for name, kind in kinds.items()
        }
        for name, camera in file.cameras.items():
            is_file = camera.topic.endswith("/compressed")
            kind = messages.CompressedImage if is_file else messages.Image
            self.sources[f"camera {name}"] = TopicSource(camera.topic, kind, "sensor")
        if file.trocar.topic:
            trocar = TopicSource(file.trocar.topic, messages.PointStamped, "latched")
            self.sources["trocar"] = trocar
        for source in self.sources.values():
            bus.read(*source)
        for name in _REPORTS:
            bus.read(file.topic(name), messages.StringStamped)
        self.forget()

    @property
    def commands(self) -> list[str]:
        """Returns the topics that it writes."""
        return [self.file.topic(name) for name in (self.file.arm.command, "jaw_servo")]

    def forget(self) -> None:
        """Forgets the last command, and the robot's warnings and errors."""
        self._q = None
        for name in _REPORTS:
            self.bus.newest.pop(self.file.topic(name), None)

    def reports(self) -> list[guard.Doubt]:
        """Returns the robot's own warnings and errors since `forget`: it refused a command."""
        newest = [(name, self.bus.newest.get(self.file.topic(name))) for name in _REPORTS]
        return [guard.Doubt("arm", name, one.string) for name, one in newest if one is not None]

    def poll(self) -> list[str]:
        """Reads all topics at once, as of one moment; returns those with a new message."""
        return self.bus.poll()

    def refresh(self) -> None:
        """Waits for new measurements: kept ones may be older than the robot."""
        awaited = {self.sources[name].topic for name in _MEASURED if name in self.sources}
        end = time.monotonic() + REFRESH_S
        while awaited and time.monotonic() < end:
            awaited -= set(self.poll())
            time.sleep(5e-4)

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
        tip = crtk.compose(self.file.pose_world_base, self.kinematics.tip_of(q))
        return guard.Snapshot(
            observed.pose,
            observed.shaft,
            observed.stamp,
            observed.image_stamp,
            observed.p_world_trocar,
            is_ready=crtk.is_ready(state),
            commanders=sum(len(self.bus.writers(topic)) for topic in self.commands),
            joints=q,
            limits=self.kinematics.limits,
            p_joints=tip.p,
        )

    def measure(self, now: float | None = None) -> RobotObservation:
        """Returns the newest measurements.

        Raises:
          UsageError: a source is missing, or a message cannot be read.
        """
        if missing := self.missing():
            raise UsageError("robot", "a message of each topic", f"none of {', '.join(missing)}")
        now = self.bus.now() if now is None else now
        ages = [self.age(name, now) for name in _MEASURED if name in self.sources]
        cameras = [name for name in self.sources if name.startswith("camera ")]
        shown = {name.removeprefix("camera "): self._image(name) for name in cameras}
        base, q = self.file.pose_world_base, self._joints()
        if self._is_psm:
            frames = crtk.Frames(base, self._tip, self._base_name)
            pose = crtk.pose_of(self._newest("pose"), frames)
        else:
            pose = crtk.compose(base, self.kinematics.tip_of(q))
        return RobotObservation(
            pose=pose,
            gripper=np.float32(crtk.opening_of(self._newest("jaw"), self.file.jaw)),
            images=shown or None,
            stamp=now - _oldest(ages),
            image_stamp=now - _oldest([self.age(name, now) for name in cameras]) if shown else None,
            shaft=crtk.compose(base, self.kinematics.shaft_of(q)),
            p_world_trocar=self._p_world_trocar() if "trocar" in self.sources else None,
        )

    def check_first(self, command: Command) -> list[guard.Doubt]:
        """Compares a command with the robot's setpoint, both in the base frame."""
        if not self._is_psm:
            q = crtk.joints_of(self._newest("joint_setpoint"), self._names())
            return guard.check_first(self._tip_in_base(command), self.kinematics.tip_of(q))
        tool = crtk.Frames(_IDENTITY, _IDENTITY)
        view_base = crtk.pose_view_base(self._newest("view"), self._newest("pose"))
        setpoint = crtk.pose_of(self._newest("setpoint"), tool)
        if self._newest("setpoint").header.frame_id != self._base_name or not self._base_name:
            setpoint = crtk.compose(crtk.inverse(view_base), setpoint)
        return guard.check_first(self._tool(command), setpoint)

    def send(self, command: Command) -> None:
        """Publishes a command and its jaws.

        Raises:
          UsageError: the arm does not reach it within its limits; nothing was published.
        """
        near = self._joints() if self._q is None else self._q
        q = self.kinematics.joints_of(self._tip_in_base(command), near)
        if not (far := float(np.abs(q - near).max())) <= MAX_JOINT_STEP:
            raise UsageError("joints", f"a step of {MAX_JOINT_STEP:g}", f"{far:.3g} rad or m")
        stamp = messages.stamp(self.bus.now())
        message = self._message(command, q, stamp)
        if not self._writers:
            topics = [*self.commands, self.file.topic("hold")]
            kinds = type(message), messages.JointState, messages.Empty
            for topic, kind in zip(topics, kinds, strict=True):
                self._writers[topic] = self.bus.writer(topic, kind, "servo")
        arm, jaw = self.commands
        self._writers[arm].write(message)
        jaws = messages.JointState(messages.Header(stamp, self.file.arm.frame), ["jaw"])
        self._writers[jaw].write(crtk.fill_jaw(jaws, float(command.gripper), self.file.jaw))
        self._q = q
        self.sent += 1

    def hold(self) -> None:
        """Asks the robot to hold, by CRTK's `hold`, if it has had a command."""
        if self._writers:
            self._writers[self.file.topic("hold")].write(messages.Empty())

    def _message(self, command: Command, q: np.ndarray, stamp: messages.Time) -> Any:
        """Returns `servo_jp` or `servo_cp` of a command, with the frame in its header."""
        if self.file.arm.command == "servo_jp":
            out = messages.JointState(messages.Header(stamp, self.file.arm.frame))
            return crtk.fill_joints(out, q, self._names())
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
        return crtk.joints_of(self._newest("joints"), self._names())

    def _names(self) -> Any:
        return crtk.names_of(self._newest("joints"), self.kinematics.names)

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
        if isinstance(message, messages.CompressedImage):
            try:
                picture = Image.open(io.BytesIO(bytes(message.data))).convert("RGB")
            except OSError as error:
                raise UsageError(name, "a JPEG or PNG file", str(error)) from None
            return images.square(np.asarray(picture), self._size)
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
