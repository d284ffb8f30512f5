"""Drives a robot from another process: a server with the packaged policy, and a loop of 30 Hz.

Copy `Robot` and `drive`; the server is `starjax serve` on a machine with a GPU.
"""

import re
import subprocess
import sys

import jax
import numpy as np

from starjax import deploy, rcm, runtime

P_WORLD_REF = np.array([0.0, 0.0, 0.15], np.float32)  # m, the policy's nominal trocar


class Robot:
    """A perfect robot: it reaches each command at once, and its images are black."""

    def __init__(self, pose: deploy.Pose) -> None:
        self.pose, self.gripper = pose, 1.0
        self.image = np.zeros((128, 128, 3), np.uint8)

    def measure(self) -> deploy.Observation:
        return deploy.Observation(pose=self.pose, gripper=self.gripper, image=self.image)

    def send(self, command: deploy.Command) -> None:
        self.pose, self.gripper = command.pose, float(command.gripper)


def drive(address: str, seconds: float) -> None:
    trocar = rcm.trocar_from_position([0.014, 0.014, 0.153], P_WORLD_REF)  # measured
    start, _ = rcm.ACTION_SPACES["rcm4"].decode([0.0, 0.0, 0.0, 0.03], trocar, P_WORLD_REF)
    robot = Robot(jax.tree.map(np.asarray, start))
    with deploy.Client(address, trocar) as client:
        report = client.run(robot, seconds)
        off = 1e3 * float(rcm.rcm_error(robot.pose, client.p_world_trocar))
    print(
        f"{report.steps} commands of {report.plans} plans, {report.missed} of them late; "
        f"{report.held} held; RCM error {off:.1e} mm; {report.alarm or 'no alarm'}"
    )


def main() -> None:
    runtime.prepare_xla()
    command = [sys.executable, "-m", "starjax", "serve", "--port", "0", "--batch", "1"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            lines = iter(server.stdout.readline, "")  # type: ignore[union-attr]
            matches = (re.search(r"ws://\S+:\d+", line) for line in lines)
            drive(next(match[0] for match in matches if match), seconds=2.0)
        finally:
            server.terminate()


if __name__ == "__main__":
    main()
