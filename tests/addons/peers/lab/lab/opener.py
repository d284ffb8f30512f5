"""A policy that is a program: it goes to the knob, closes, and follows the knob's arc."""

import numpy as np

from starjax.policies.external import ExternalPolicy

HINGE, KNOB = np.array([-0.015, 0.0, 0.009]), (0.030, 0.007)
HORIZON, STEP = 4, 0.0015  # commands of a plan, m a control step
NEAR = 0.002  # m


class Opener:
    """Keeps nothing between calls: several episodes call one object."""

    def act(self, observation):
        """Returns the next commands `[H, 8]`."""
        pose = np.array(observation["observation/state"], float)
        *knob, half = observation["observation/environment_state"]
        angle, tip = 2.0 * half, pose[:3]
        away = np.asarray(knob) - tip
        rows = []
        for _ in range(HORIZON):
            if np.linalg.norm(away[:2]) > NEAR and pose[7] > 0.5:
                goal, grip = np.add(knob, (0, 0, 0.012)), 1.0
            elif pose[7] > -0.2 and np.linalg.norm(away) > NEAR:
                goal, grip = np.asarray(knob), 1.0
            else:
                angle = min(angle + 0.05, 1.15)
                c, s = np.cos(angle), np.sin(angle)
                along, above = KNOB
                goal = np.add(HINGE, (along * c - above * s, 0.0, along * s + above * c))
                grip = -1.0
            way = goal - tip
            tip = tip + way * min(1.0, STEP / max(np.linalg.norm(way), 1e-9))
            rows.append([*tip, *pose[3:7], grip])
        return np.array(rows, np.float32)


OPENER = ExternalPolicy("opens the lid", "lid", Opener, observation="state")
