"""Drives a robot with the packaged policy: measure, plan ahead of time, command at 30 Hz.

Copy this and put your robot behind `Robot`.
"""

import time

import jax
import numpy as np

from starjax import deploy, rcm


class Robot:
    """A perfect robot: it reaches each command at once, and its images are black."""

    def __init__(self, pose: deploy.Pose, image_size: int) -> None:
        self.pose, self.gripper, self.image_size = pose, 1.0, image_size
        self.camera = np.zeros((480, 640, 3), np.uint8)  # BGR, as OpenCV has it

    def measure(self) -> deploy.Observation:
        """Measures the tip in the world, the opening of the jaws in [-1, 1], and the image."""
        image, now = deploy.square(self.camera, self.image_size, bgr=True), time.time()
        return deploy.Observation(self.pose, self.gripper, image=image, stamp=now, image_stamp=now)

    def send(self, command: deploy.Command) -> None:
        """Takes a command, to be reached within 1/30 s."""
        self.pose, self.gripper = command.pose, float(command.gripper)


def main() -> None:
    policy = deploy.load("compact")
    p_world_trocar = np.array([0.014, 0.014, 0.153], np.float32)  # m, measured
    trocar = rcm.trocar_from_position(p_world_trocar, policy.p_world_ref)
    start, _ = rcm.ACTION_SPACES["rcm4"].decode([0.0, 0.0, 0.0, 0.03], trocar, policy.p_world_ref)
    robot = Robot(jax.tree.map(np.asarray, start), policy.settings.image_size)
    report = deploy.drive(robot, policy, trocar, seconds=2.0, key=jax.random.key(0))
    off = 1e3 * float(rcm.rcm_error(robot.pose, p_world_trocar))
    print(
        f"{report.steps} commands of {report.plans} plans, {report.held} held; "
        f"tip {np.round(1e3 * robot.pose.p, 1)} mm, RCM error {off:.1e} mm"
    )


if __name__ == "__main__":
    main()
