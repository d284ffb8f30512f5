"""A page in the browser: rollouts that one can turn and steer, and teleoperation."""
