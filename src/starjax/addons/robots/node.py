"""A policy on a robot's topics: checks, commands at the arm's rate, topics for rviz."""

# pyright: reportArgumentType=false
# Sequences of messages are lists: see `messages`.

from collections.abc import Callable
from typing import Any

import numpy as np

from starjax import rcm
from starjax.addons.robots import between, markers, messages
from starjax.addons.robots.arm import WORLD, CrtkArm
from starjax.addons.robots.robot_file import RobotFile
from starjax.core.errors import UsageError
from starjax.core.types import Command
from starjax.deploy import guard
from starjax.deploy.client import Client
from starjax.deploy.plan_executor import Report

AT = "/starjax"


def tolerances(file: RobotFile, is_dry: bool = False) -> guard.Tolerances:
    """Returns a file's tolerances; an arm that gets no commands follows none."""
    limits = file.limits
    following = np.inf if is_dry else limits.following_m
    return guard.Tolerances(limits.off_trocar_m, following, limits.stale_s)


def doubts(arm: CrtkArm, client: Client) -> list[guard.Doubt]:
    """Returns the doubts about an arm that its `Client` does not see: state, commanders, joints.

    A message that cannot be read is one: it names another frame or other joints, or is no image.
    """
    now, where = arm.bus.now(), client.p_world_trocar
    try:
        snapshot = arm.snapshot(now)
    except UsageError as error:
        return [guard.Doubt("arm", "message", str(error)), *arm.reports()]
    found = guard.check(snapshot, (), where, now, tolerances(arm.file))
    if missing := arm.missing():
        found.append(guard.Doubt("arm", "topics", f"no message of {', '.join(missing)}"))
    return [doubt for doubt in found if doubt.kind == "arm"] + arm.reports()


def run(
    arm: CrtkArm,
    client: Client,
    seconds: float,
    *,
    is_dry: bool = False,
    confirm: Callable[[str], bool] = lambda reason: False,
    should_stop: Callable[[], bool] = lambda: False,
) -> Report:
    """Drives an arm for `seconds`; a doubt ends the commands until `confirm` of its reason.

    Each command of the policy is sent as the last of `rate / 30` on the way there, so the arm is a
    control step behind.

    Args:
      arm: with all its topics.
      client: of the policy.
      seconds: of the run.
      is_dry: publish the plan only.
      confirm: asks a person, who has looked at the arm; the run ends on False.
      should_stop: called once per control step.

    Raises:
      UsageError: the arm is in doubt at the start.
    """
    arm.forget()
    shown = Shown(arm)
    steps = max(1, round(arm.file.arm.rate / client.control_hz))
    way = between.of(client.input_spec.held_wrist, steps)
    seen = arm.measure()
    still = Command(seen.pose, seen.gripper)
    way(still, still, client.p_world_trocar)  # compiles, as does an error
    rcm.rcm_error(seen.shaft, client.p_world_trocar)
    arm.refresh()
    period, due, last = 1.0 / arm.file.arm.rate, arm.bus.now(), None
    for _ in range(round(seconds * client.control_hz)):
        arm.poll()
        bad = doubts(arm, client)
        command = None if bad else client.step(arm.measure())
        if command is not None and last is None and not is_dry:
            bad = arm.check_first(command)
        if bad:
            _stop(client, str(bad[0]))
            command = None
        if command is not None:
            shown.show(command, client)
            for one in way(last or command, command, client.p_world_trocar):
                if not is_dry:
                    try:
                        arm.send(one)
                    except UsageError as error:
                        _stop(client, f"out of reach: {error}")
                        command = None
                        break
                now, due = arm.bus.now(), due + period
                client.report.overran += now > due
                due = max(due, now - period)  # lost periods are not made up for
                arm.bus.wait(due)
        last = command
        if command is None:
            reason = client.report.fault
            arm.hold()
            shown.show(None, client)
            if should_stop() or not confirm(reason):
                break
            arm.forget()
            arm.refresh()
            client.restart(arm.measure())
            due = arm.bus.now()
        elif should_stop():
            break
    return client.report


def _stop(client: Client, fault: str) -> None:
    client.stop(fault)
    client.report.silent += 1


class Shown:
    """Topics for rviz and recordings, in the world's frame, and texts as CRTK names them."""

    def __init__(self, arm: CrtkArm) -> None:
        self._arm = arm
        text, number = messages.StringStamped, messages.Float64
        kinds: dict[str, tuple[Any, str]] = {
            "plan": (messages.Path, "default"),
            "markers": (markers.MarkerArray, "default"),
            "trocar": (messages.PointStamped, "latched"),
            "rcm_error": (number, "default"),
            "alarm": (text, "latched"),
            **dict.fromkeys(("state", "warning", "error"), (text, "latched")),
        }
        self._writers = {n: arm.bus.writer(f"{AT}/{n}", *kind) for n, kind in kinds.items()}
        self._texts: dict[str, str] = {}

    def show(self, command: Command | None, client: Client) -> None:
        """Publishes the present plan and error, and texts that changed.

        Args:
          command: None at a stop; the report has its reason.
        """
        report = client.report
        header = messages.Header(messages.stamp(self._arm.bus.now()), WORLD)
        view = [str(doubt) for doubt in client.doubts if doubt.kind == "view"]
        texts = {
            "state": report.fault if command is None else "running",
            "error": report.fault if command is None else "",
            "warning": "; ".join(view),
            "alarm": report.alarm,
        }
        for name, text in texts.items():
            if text != self._texts.get(name, ""):
                self._texts[name] = text
                self._writers[name].write(messages.StringStamped(header, text))
                where = messages.Point(*map(float, client.p_world_trocar))
                self._writers["trocar"].write(messages.PointStamped(header, where))
        if command is None:
            return
        path = [
            messages.PoseStamped(header, messages.PoseMessage(messages.Point(*map(float, p))))
            for p in client.plan
        ]
        self._writers["plan"].write(messages.Path(header, path))
        seen = self._arm.measure()
        off = float(rcm.rcm_error(seen.shaft, client.p_world_trocar))
        self._writers["rcm_error"].write(messages.Float64(off))
        text = texts["alarm"] or texts["warning"] or texts["state"]
        shown = markers.of(header, client.p_world_trocar, seen.pose.p, client.plan, off, text)
        self._writers["markers"].write(shown)
