"""Runs the packaged policy in a robot's loop: measure, plan, execute half of the plan, repeat.

Copy this and put your robot behind `Robot`.
"""

import jax
import numpy as np

from starjax import deploy, rcm


class Robot:
    """A perfect robot: it reaches each command at once, and its images are black."""

    def __init__(self, pose: deploy.Pose, image_size: int) -> None:
        self.pose, self.gripper = pose, 1.0
        self.image = np.zeros((image_size, image_size, 3), np.uint8)

    def measure(self) -> tuple[deploy.Pose, float, np.ndarray]:
        """Returns the tip pose in the world, the opening of the jaws in [-1, 1], the image."""
        return self.pose, self.gripper, self.image

    def send(self, pose: deploy.Pose, gripper: float) -> None:
        """Takes a control step of 1/30 s."""
        self.pose, self.gripper = pose, gripper


def main() -> None:
    policy = deploy.load("compact")
    settings = policy.settings
    p_world_trocar = np.array([0.014, 0.014, 0.153], np.float32)  # m, measured
    trocar = rcm.trocar_from_position(p_world_trocar, policy.p_world_ref)
    start, _ = rcm.ACTION_SPACES["rcm4"].decode([0.0, 0.0, 0.0, 0.03], trocar, policy.p_world_ref)
    robot = Robot(jax.tree.map(np.asarray, start), settings.image_size)
    history = [robot.measure()] * settings.obs_horizon
    key = jax.random.key(0)
    for i in range(4):
        poses, grippers, images = zip(*history[-settings.obs_horizon :], strict=True)
        observation = deploy.Observation(
            pose=jax.tree.map(lambda *x: np.stack(x), *poses),
            gripper=np.array(grippers, np.float32),
            image=np.stack(images),
        )
        plan = policy(jax.random.fold_in(key, i), observation, trocar)
        plan = jax.tree.map(np.asarray, plan)
        for t in range(settings.execute):
            robot.send(jax.tree.map(lambda x: x[t], plan.pose), float(plan.gripper[t]))  # noqa: B023
            history.append(robot.measure())
        off = 1e3 * float(rcm.rcm_error(robot.pose, p_world_trocar))
        print(f"plan {i}: tip {np.round(1e3 * robot.pose.p, 1)} mm, RCM error {off:.1e} mm")


if __name__ == "__main__":
    main()
