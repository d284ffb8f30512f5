"""Draws images/wrist.png: one tip pose through three trocars, and the wrist's gain.

python docs/draw_wrist.py
"""

import pathlib

import matplotlib.pyplot as plt
import numpy as np

from starjax import rcm

WRIST = rcm.LARGE_NEEDLE_DRIVER
TROCARS = np.array([[-0.05, 0.0, 0.1], [0.0, 0.0, 0.12], [0.045, 0.0, 0.11]], np.float32)  # m
TIP = np.array([0.0, 0.0, 0.01], np.float32)  # m
LEAN = np.deg2rad(20.0)  # of the jaws
DEPTHS = (0.03, 0.06, 0.11)  # m, of the pitch axis


def main() -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.6), dpi=110)
    draw_shafts(left)
    draw_gain(right)
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    figure.savefig(pathlib.Path(__file__).parent / "images" / "wrist.png")


def draw_shafts(axes: plt.Axes) -> None:
    """Draws shafts with the yaw axis across the picture: all lie in it and the pitch is zero."""
    x, z = np.array([0.0, 1.0, 0.0]), np.array([np.sin(LEAN), 0.0, -np.cos(LEAN)])
    tip = rcm.Pose(np.stack([x, np.cross(z, x), z], -1).astype(np.float32), TIP)
    for trocar in TROCARS:
        angles = rcm.angles_through(WRIST, tip, trocar)
        pitch_axis = np.asarray(rcm.shaft_of(WRIST, tip, angles).p)
        points = np.stack([trocar, pitch_axis, TIP - WRIST.jaws * z, TIP])
        outside = trocar + 0.25 * (trocar - pitch_axis)
        points = 1e3 * np.stack([outside, *points])[:, [0, 2]]
        (line,) = axes.plot(*points.T, lw=2.5, alpha=0.8)
        axes.plot(*points[2:4].T, "o", color=line.get_color(), ms=4)
        axes.plot(*points[1], "s", color="black", ms=6)
        label = f"yaw {np.rad2deg(float(angles[1])):.0f}°"
        axes.annotate(label, points[1], (8, 0), textcoords="offset points")
    axes.set_aspect("equal")
    axes.set_xlabel("x, mm")
    axes.set_ylabel("z, mm")
    axes.set_title("one tip pose, three trocars")


def draw_gain(axes: plt.Axes) -> None:
    pitch = np.linspace(0.0, 85.0, 200)
    for depth in DEPTHS:
        gain = depth / (WRIST.clevis + depth * np.cos(np.deg2rad(pitch)))
        axes.plot(pitch, gain, label=f"d = {1e3 * depth:.0f} mm")
    axes.axvline(np.rad2deg(WRIST.pitch), color="gray", ls=":")
    axes.set_xlabel("pitch, degrees")
    axes.set_title("turn of roll and yaw per turn of the tip")
    axes.set_ylim(0.0, None)
    axes.legend(frameon=False)


if __name__ == "__main__":
    main()
