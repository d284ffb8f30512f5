"""Turns a needle about its centre with an instrument that has a wrist, through several trocars.

The tip follows the same arc at every trocar; the shaft and the wrist's angles differ.
"""

import numpy as np

from starjax import rcm

WRIST = rcm.LARGE_NEEDLE_DRIVER
RADIUS = 0.012  # m, of the needle
TURN = np.deg2rad(120.0)
P_WORLD_REF = np.array([0.0, 0.0, 0.15])  # m, the nominal trocar


def main() -> None:
    angle = np.linspace(-TURN / 2, TURN / 2, 60)
    zero, one = np.zeros_like(angle), np.ones_like(angle)
    # The jaws hold the needle from above and turn with it, about the horizontal x axis.
    z = np.stack([zero, -np.sin(angle), -np.cos(angle)], -1)
    x = np.stack([one, zero, zero], -1)
    arc = rcm.Pose(np.stack([x, np.cross(z, x), z], -1), np.array([0.0, 0.0, 0.03]) - RADIUS * z)
    for number in range(4):
        trocar = rcm.trocar_position(
            rcm.Trocar(*(field[number] for field in rcm.TROCARS)), P_WORLD_REF
        )
        found = rcm.through(WRIST, arc, trocar)
        error = rcm.rcm_error(rcm.shaft_of(WRIST, found.pose, found.wrist), trocar)
        pitch, yaw = np.rad2deg(np.abs(found.wrist).max(0))
        print(
            f"trocar {number}: {np.mean(found.is_feasible):.0%} of the arc is feasible, pitch to "
            f"{pitch:.0f} and yaw to {yaw:.0f} degrees, RCM error {1e3 * error.max():.4f} mm"
        )


if __name__ == "__main__":
    main()
