"""A policy on a robot's topics: checks, commands at the arm's rate, topics for rviz."""

# pyright: reportArgumentType=false
# Sequences of messages are lists: see `messages`.

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from starjax import rcm
from starjax.addons.robots import between, messages
from starjax.addons.robots.arm import WORLD, CrtkArm
from starjax.addons.robots.robot_file import RobotFile
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
    """Returns the doubts about an arm that its `Client` does not see: state, commanders, joints."""
    now, where = time.time(), client.p_world_trocar
    found = guard.check(arm.snapshot(now), (), where, now, tolerances(arm.file))
    if missing := arm.missing():
        found.append(guard.Doubt("arm", "topics", f"no message of {', '.join(missing)}"))
    return [doubt for doubt in found if doubt.kind == "arm"]


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
    shown = Shown(arm)
    steps = max(1, round(arm.file.arm.rate / client.control_hz))
    way = between.of(client.input_spec.held_wrist, steps)
    seen = arm.measure()
    still = Command(seen.pose, seen.gripper)
    way(still, still, client.p_world_trocar)  # compiles, as does an error
    rcm.rcm_error(seen.shaft, client.p_world_trocar)
    period, due, last = 1.0 / arm.file.arm.rate, time.monotonic(), None
    for _ in range(round(seconds * client.control_hz)):
        arm.poll()
        if bad := doubts(arm, client):
            client.stop(str(bad[0]))
        command = None if arm.missing() else client.step(arm.measure())
        first = [] if command is None or last else arm.check_first(command)
        if first and not is_dry:
            client.stop(str(first[0]))
            command = None
        if command is None:
            last, reason = None, client.report.fault
            shown.show(None, client, reason)
            if should_stop() or not confirm(reason):
                break
            arm.poll()
            client.restart(arm.measure())
            due = time.monotonic()
            continue
        shown.show(command, client, "running")
        for one in way(last or command, command, client.p_world_trocar):
            if not is_dry:
                arm.send(one)
            due = max(due + period, time.monotonic() - period)  # lost periods are not made up for
            time.sleep(max(due - time.monotonic(), 0.0))
        last = command
        if should_stop():
            break
    return client.report


class Shown:
    """Topics for rviz and recordings: plan, trocar, RCM error, state; all in the world's frame."""

    def __init__(self, arm: CrtkArm) -> None:
        self._arm = arm
        kinds: dict[str, tuple[Any, str]] = {
            "plan": (messages.Path, "default"),
            "trocar": (messages.PointStamped, "latched"),
            "rcm_error": (messages.Float64, "default"),
            "state": (messages.StringStamped, "latched"),
        }
        self._writers = {n: arm.bus.writer(f"{AT}/{n}", *kind) for n, kind in kinds.items()}
        self._reason = ""

    def show(self, command: Command | None, client: Client, reason: str) -> None:
        """Publishes the present plan and error; the state when it changes."""
        header = messages.Header(messages.stamp(), WORLD)
        if reason != self._reason:
            self._reason = reason
            self._writers["state"].write(messages.StringStamped(header, reason))
            where = messages.Point(*map(float, client.p_world_trocar))
            self._writers["trocar"].write(messages.PointStamped(header, where))
        if command is None:
            return
        path = [
            messages.PoseStamped(header, messages.PoseMessage(messages.Point(*map(float, p))))
            for p in client.plan
        ]
        self._writers["plan"].write(messages.Path(header, path))
        shaft = self._arm.measure().shaft
        off = float(rcm.rcm_error(shaft, client.p_world_trocar))
        self._writers["rcm_error"].write(messages.Float64(off))
