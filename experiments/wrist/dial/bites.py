"""The dial: the turn of a needle decides if one grasp serves every trocar.

    python experiments/wrist/dial/bites.py [--tiny]

A needle of needle pick's radius enters a level pad at the board's middle, turns along its arc and
leaves: from 10 degrees before its point enters to 20 degrees after it left. The depth of the arc's
centre sets the turn, and with it the bite. The jaws hold the wire level with the centre when the
point leaves. A grasp is the turn about the wire and a lean of the jaws along it. It serves a trocar
if the wrist stays within its limits, and palm and shaft clear of the pad, along the whole arc.

For each of some directions of the bite: is there a grasp for a trocar, one for the eight seen
trocars, one for all twelve? Closed form, no simulation, no time.
"""

import argparse
import pathlib
import sys
from typing import Any

sys.path.append(str(pathlib.Path(__file__).parents[3] / "benchmarks"))
import _timing
import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm, runtime
from starjax.core.types import Pose
from starjax.sim import registries
from starjax.tasks.needle_pick import task as pick

TOOL = registries.tools.get("needle_driver")
P_WORLD_REF = np.array([0.0, 0.0, 0.15], np.float32)  # m
TURNS = tuple(range(84, 151, 6))  # degrees
LEAD, REST = np.deg2rad(10.0), np.deg2rad(20.0)  # before the point enters, after it left
STEPS = 40  # along an arc
ABOUT, LEANS = np.arange(0, 360, 15), np.arange(-45, 46, 15)  # degrees: about the wire, along it
DIRECTIONS = 36


def main() -> None:
    runtime.prepare_xla()
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tiny", action="store_true", help="a few directions, nothing written")
    tiny = parser.parse_args().tiny
    directions = 2 if tiny else DIRECTIONS
    found = {}
    for turn in TURNS[::11] if tiny else TURNS:
        found[str(turn)] = row = shares(turn, directions)
        print(turn, row, flush=True)
    sizes = {"directions": directions, "grasps": len(ABOUT) * len(LEANS), "trocars": 12}
    _timing.report("dial", {**sizes, "results": found}, tiny)


def shares(turn_deg: float, directions: int) -> dict[str, Any]:
    """Fractions of directions in which a grasp serves each trocar, the seen ones, all of them."""
    assert TOOL.wrist is not None
    sweep = 0.5 * (np.deg2rad(turn_deg) - LEAD - REST)  # rad below the pad, either way
    pose = arcs(sweep, 2.0 * np.pi * np.arange(directions) / directions)
    trocars = np.asarray(rcm.trocar_position(rcm.TROCARS, P_WORLD_REF))
    served = np.array([jax.device_get(_served(pose, trocar)) for trocar in trocars])
    own = served.any((2, 3)).mean(1)
    return {
        "bite_mm": float(2e3 * pick.RADIUS * np.sin(sweep)),
        "by_trocar": own.tolist(),
        "own_grasp": float(own.mean()),
        "one_for_seen": float(served[rcm.IS_SEEN].all(0).any((1, 2)).mean()),
        "one_for_all": float(served.all(0).any((1, 2)).mean()),
    }


def arcs(sweep: float, azimuths: np.ndarray) -> Pose:
    """Tip poses `[directions, about, leans, steps]` along the arc, the pad at z = 0."""
    theta = np.linspace(-sweep - LEAD, sweep + REST, STEPS)
    out, along = theta - sweep - np.pi / 2, np.array([0.0, 0.0, 1.0])
    grid = np.ix_(azimuths, np.deg2rad(ABOUT), np.deg2rad(LEANS), out)
    azimuth, about, lean, angle = (x[..., None] for x in grid)
    forward = np.concatenate([np.cos(azimuth), np.sin(azimuth), 0.0 * azimuth], -1)
    normal = np.cross(along, forward)
    radial = np.sin(angle) * forward - np.cos(angle) * along
    tangent = np.cos(angle) * forward + np.sin(angle) * along
    z = np.cos(about) * normal - np.sin(about) * radial
    z, x = np.cos(lean) * z + np.sin(lean) * tangent, np.cos(lean) * tangent - np.sin(lean) * z
    x, z = np.broadcast_arrays(x, z)
    p = pick.RADIUS * (np.cos(sweep) * along + np.broadcast_to(radial, x.shape))
    return Pose(np.stack([x, np.cross(z, x), z], -1).astype(np.float32), p.astype(np.float32))


@jax.jit
def _served(pose: Pose, p_world_trocar: jax.Array) -> jax.Array:
    """Returns `[directions, about, leans]`: True for grasps that serve the trocar."""
    wrist: Any = TOOL.wrist
    angles = rcm.angles_through(wrist, pose, p_world_trocar)
    within = (jnp.abs(angles) <= jnp.array([wrist.pitch, wrist.yaw])).all(-1)
    palm = pose.p[..., 2] - wrist.jaws * pose.R[..., 2, 2]
    shaft = rcm.shaft_of(wrist, pose, angles).p[..., 2]
    clear = (palm >= TOOL.palm_radius) & (shaft >= TOOL.shaft_radius)
    return (within & clear).all(-1)


if __name__ == "__main__":
    main()
