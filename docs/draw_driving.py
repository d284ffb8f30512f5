"""Draws images/driving.png: a needle on its arc through a pad, and the forces across its hole.

python docs/draw_driving.py
"""

import pathlib

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from starjax.addons.suture.needle_drive import grasps, task
from starjax.addons.suture.tissue import driving, prescribed
from starjax.addons.suture.tissue import needle as needles
from starjax.core.types import Pose
from starjax.tasks import scripting

SIZE = needles.CT1
H, SECONDS = 1.0 / 240.0, 4.0
# kg and kg m^2 of the needle CT-1 with its joint's armature, as in needle_drive.xml.
BODY = driving.Body(np.array([1.83e-4] * 3 + [4.01e-6] * 3), 1.79e-4)
BITE = needles.Bite(jnp.array([-0.006, 0.0, 0.0]), jnp.array([0.006, 0.0, 0.0]))
BEFORE, AFTER = 0.2, 0.35  # rad on the arc
MOMENTS = (0.0, 0.3, 0.5, 1.0)  # fractions of the drive
ASIDE = (0.0, 0.001, 0.002)  # m, of the jaws at the end of the drive


@jax.jit
def driven(aside: jax.Array) -> tuple[prescribed.DriveMoment, jax.Array]:
    """Returns the moments of a drive whose jaws end `aside` m off the arc, and the turns (rad)."""
    half, held = needles.entry_angle(SIZE, BITE), grasps.grasp(SIZE)

    def tip_at(share: jax.Array) -> tuple[Pose, jax.Array]:
        share = scripting.sloped(share)
        turn = -half - BEFORE + share * (2.0 * half + BEFORE + AFTER)
        needle = needles.pose_on(SIZE, BITE, turn)
        R = needle.R @ held.R.T
        return Pose(R, needle.p - R @ held.p + share * aside * jnp.array([0.0, 1.0, 0.0])), turn

    tips, turns = jax.vmap(tip_at)(jnp.linspace(0.0, 1.0, round(SECONDS / H) + 1))
    start = needles.pose_on(SIZE, BITE, turns[0])
    return prescribed.run(SIZE, BODY, tips, start, -jnp.ones(()), H), turns[1:]


def main() -> None:
    drives = {aside: jax.tree.map(np.asarray, driven(jnp.asarray(aside))) for aside in ASIDE}
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.4), dpi=110)
    draw_needles(left, *drives[0.0])
    for aside, (moments, turns) in drives.items():
        force = moments.tissue.hole.force
        right.plot(np.rad2deg(turns), force, label=f"jaws {1e3 * aside:.0f} mm aside at the end")
    right.axhline(task.MAX_FORCE, color="gray", ls=":")
    right.set_xlabel("turn of the needle, degrees")
    right.set_title("force across the hole, N")
    right.legend(frameon=False)
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    figure.savefig(pathlib.Path(__file__).parent / "images" / "driving.png")


def draw_needles(axes: plt.Axes, moments: prescribed.DriveMoment, turns: np.ndarray) -> None:
    """Draws the wire at a few moments in the plane of its arc, and the points of the hole."""
    axes.margins(x=0.15)
    axes.axhspan(-5.0, 0.0, color="#dc9a8c", alpha=0.5, lw=0.0)
    angles = jnp.linspace(-SIZE.end, SIZE.end, 60)
    for share in MOMENTS:
        k = round(share * (len(turns) - 1))
        pose = jax.tree.map(lambda leaf, k=k: jnp.asarray(leaf[k]), moments.pose)
        wire = 1e3 * np.asarray(jax.vmap(lambda a, p=pose: needles.point_at(SIZE, p, a))(angles))
        (line,) = axes.plot(wire[:, 0], wire[:, 2], lw=2.0, alpha=0.8)
        x, z = wire[-1, [0, 2]]
        axes.plot(x, z, "D", color=line.get_color(), ms=5)
        axes.annotate(f"{share * SECONDS:.1f} s", (x, z), (8, 4), textcoords="offset points")
    points = 1e3 * moments.tissue.hole.points[-1]
    axes.plot(points[:, 0], points[:, 2], "o", color="black", ms=5)
    axes.set_aspect("equal")
    axes.set_ylim(-5.0, None)
    axes.set_xlabel("along the bite, mm")
    axes.set_ylabel("height, mm")
    axes.set_title("wire, its point in time, and the hole")


if __name__ == "__main__":
    main()
