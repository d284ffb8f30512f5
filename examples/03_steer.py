"""Steers a tool by increments; the shaft stays in the trocar for any input.

Copy this for a SpaceMouse or a keyboard: `read` stands for the device.
"""

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm

P_WORLD_REF = np.array([0.0, 0.0, 0.15], np.float32)  # m, nominal trocar
PERIOD = 1 / 30  # s
SPEED = 0.05  # m/s at full deflection
SPIN = 1.0  # rad/s at full deflection
SPACE = rcm.ACTION_SPACES["rcm4"]


def read(t: int) -> np.ndarray:
    """Returns the deflection (roll, x, y, z) in [-1, 1] of a device; here a sinking circle."""
    return np.array([0.2, np.cos(0.1 * t), np.sin(0.1 * t), -0.3])


@jax.jit
def steer(
    action: jax.Array, deflection: jax.Array, frame: rcm.TrocarFrame
) -> tuple[rcm.Pose, jax.Array]:
    """Returns the next pose of the tool and its action."""
    scale = PERIOD * jnp.array([SPIN, SPEED, SPEED, SPEED])
    pose, _ = SPACE.decode(action + scale * deflection, frame)
    return pose, SPACE.encode(pose, frame)


def main() -> None:
    trocar = rcm.trocar_from_position([0.02, 0.0, 0.15], P_WORLD_REF)
    frame = rcm.trocar_frame(trocar, P_WORLD_REF)
    action = jnp.array([0.0, 0.0, 0.0, 0.05])
    worst = 0.0
    for t in range(90):
        pose, action = steer(action, read(t), frame)
        worst = max(worst, float(rcm.rcm_error(pose, frame.p_world_trocar)))
    print(
        f"tip at {np.round(1e3 * np.asarray(pose.p), 1)} mm; RCM error at most {1e3 * worst:.1e} mm"
    )


if __name__ == "__main__":
    main()
