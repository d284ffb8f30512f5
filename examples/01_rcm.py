"""Turns any numbers into tool poses whose shaft passes through the trocar.

`starjax.rcm` needs jax and numpy only. Its functions broadcast, have finite gradients, and
run compiled, also when they are called with arrays as in a robot's loop.
"""

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm

P_WORLD_REF = np.array([0.0, 0.0, 0.15], np.float32)  # m, nominal trocar


def main() -> None:
    trocars = rcm.sample_trocar(jax.random.key(0), (1000,))  # Eq. 19 of the paper
    frames = rcm.trocar_frame(trocars, P_WORLD_REF)

    space = rcm.ACTION_SPACES["rcm4"]  # roll, and tip position in the world
    actions = 0.05 * jax.random.normal(jax.random.key(1), (1000, space.dim))
    poses, valid = jax.jit(space.decode)(actions, frames)
    error = rcm.rcm_error(poses, frames.p_world_trocar).max()
    print(f"{int(valid.sum())} poses, at most {1e6 * float(error):.2f} um off their trocars")

    # Gradient descent through the map moves one tip to a point.
    goal = jnp.array([0.02, -0.01, 0.01])
    frame = jax.tree.map(lambda x: x[0], frames)

    def distance(action: jax.Array) -> jax.Array:
        pose, _ = space.decode(action, frame)
        return jnp.sum((pose.p - goal) ** 2)

    action = jnp.array([0.0, 0.0, 0.0, 0.05])
    for _ in range(50):
        action -= 0.4 * jax.grad(distance)(action)
    print(f"tip {1e3 * float(distance(action)) ** 0.5:.4f} mm from its goal")


if __name__ == "__main__":
    main()
