"""Defines an action space: two functions between a pose and its named parts.

Here the tip's height is relative to the trocar, and the rest as in `rcm4`. `make_space` adds the
checks, the broadcasting and a safe pose for values that are not finite. In a package of your own
the entry point `starjax.action_spaces` gives it a name for methods.
"""

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.rcm import actions, manifold, rotations

P_WORLD_REF = np.array([0.0, 0.0, 0.15], np.float32)  # m, nominal trocar


def encode(pose: rcm.Pose, frame: actions.SpaceFrame) -> list[jax.Array]:
    """Returns the parts of a pose: height below the trocar, x and y in the world, roll."""
    height = frame.p[..., 2:] - pose.p[..., 2:]
    return [height, pose.p[..., :2], rotations.roll_of(pose.R)[..., None]]


def decode(parts: dict[str, jax.Array], frame: actions.SpaceFrame) -> rcm.Pose:
    """Returns the pose of parts; its shaft passes through the trocar for any of them."""
    x, y = parts["xy"][..., 0], parts["xy"][..., 1]
    p = jnp.stack(jnp.broadcast_arrays(x, y, frame.p[..., 2] - parts["height"][..., 0]), -1)
    axis, depth = manifold.axis_and_depth(p, frame.p)
    return manifold.pose_on_manifold(axis, parts["roll"][..., 0], depth, frame.p)


SPACE = actions.make_space("below", encode, decode, height=1, xy=2, roll=1)


def main() -> None:
    trocars = rcm.sample_trocar(jax.random.key(0), (100,))
    action = jnp.array([0.12, 0.01, -0.02, 0.3])
    poses, valid = SPACE.decode(action, trocars, P_WORLD_REF)
    error = rcm.rcm_error(poses, rcm.trocar_position(trocars, P_WORLD_REF)).max()
    again = SPACE.encode(poses, trocars, P_WORLD_REF)
    np.testing.assert_allclose(again, np.broadcast_to(action, again.shape), atol=1e-5)
    print(f"{int(valid.sum())} of 100 valid, at most {1e6 * float(error):.2f} um off the trocar")


if __name__ == "__main__":
    main()
