"""The way down of open jaws to a grasp: a tip above it continues there."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from starjax.addons.finetune.rescuers import midway
from starjax.sim.state import EnvState
from starjax.tasks import phases

# m aside for each m above the height at which pads reach the object: demonstrated ways begin so far
# out, with their spread
SLOPE = 0.6
TURNED = 0.3  # rad from the grasp's normal, within which low jaws come down
SPREAD = 0.003  # m above the start of the way in that still belongs to it
BELOW = 0.0015  # m below its grasp, to which a tip is still on its way in, and may close
TOLERANCE = 0.002  # m below its start, at which a tip has begun it
SLOW = 0.01  # m/s
TOWARDS = 0.6  # cosine between velocity and way, above which the tip goes there


class Room(NamedTuple):
    """Room of open jaws about a grasp.

    Attributes:
      pads: m of the tip above the grasp at which the pads reach the object.
      clearance: m aside, at which they pass it.
      top: m of the tip above the grasp, where the way in begins.
    """

    pads: float
    clearance: float
    top: float


def of(
    room: Room, way: jax.Array, aside: jax.Array, normal: jax.Array, state: EnvState
) -> tuple[jax.Array, jax.Array]:
    """Returns True for a tip on the way down, and True for one at the grasp, at any opening.

    Args:
      room: about the grasp.
      way: `[3]` m, from the tip to the grasp.
      aside: m, the tip's distance from it that counts, horizontally.
      normal: `[3]` of the grasp, along which jaws open.
      state: at this moment.
    """
    above = -way[2]
    # Shafts lean: jaws along the normal still open uphill.
    across, normal = (phases.horizontal(axis) for axis in (state.pose.R[0, :, 1], normal))
    is_turned = jnp.abs(across @ normal) > jnp.cos(TURNED)
    is_between = aside < room.clearance + SLOPE * jnp.maximum(above - room.pads, 0.0)
    is_free = is_between & (is_turned | (above > room.pads))
    is_within = (above > -BELOW) & (above < room.top + SPREAD)
    is_here = has_come(way, jnp.asarray(room.top), state.velocity[0, :3])
    is_coming = is_free & is_within & is_here & (state.gripper_target[0] > 0.0)
    return is_coming, is_free & (above > -BELOW) & (above < midway.ARRIVED)


def has_come(way: jax.Array, top: jax.Array, velocity: jax.Array) -> jax.Array:
    """Returns False `[...]` for a tip at the start of its way in that goes elsewhere, and fast.

    Args:
      way: `[..., 3]` m, from the tip to the grasp.
      top: `[...]` m above the grasp, where the way in begins.
      velocity: `[..., 3]` m/s of the tip.
    """
    speed, far = (jnp.linalg.norm(x, axis=-1) for x in (velocity, way))
    goes_there = jnp.sum(velocity * way, axis=-1) > TOWARDS * speed * far
    return (speed < SLOW) | goes_there | (-way[..., 2] < top - TOLERANCE)
