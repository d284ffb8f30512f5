"""Figures of recordings: paths about the trocar, one episode over time, spreads over episodes."""

import io
from collections.abc import Sequence
from typing import Any

import numpy as np

from starjax.data.recordings import EpisodeMotion, MotionFigures
from starjax.report import style

_PATHS = 12  # episodes whose paths are drawn
_LEAST_MM = 0.01  # range of an axis of distances: rounding errors do not fill it
_COLOURS = ("#2083C5", "#D55E00", "#009E73", "#CC79A7")  # colours of the arms


def paths(found: Sequence[EpisodeMotion], dark: bool = False) -> Any:
    """Draws tips and trocars from above and from the side, in mm from the mean trocar."""
    centre = np.mean([r.p_world_trocar for r in found], axis=(0, 1))
    with style.use(dark) as shades:
        figure = style.figure(7.4, 3.6)
        axes = figure.subplots(1, 2)
        views = ((0, 1, "from above", "y (mm)"), (0, 2, "from the side", "z (mm)"))
        for axis, (i, j, title, label) in zip(axes, views):
            for recording in found[:_PATHS]:
                for arm in range(recording.p.shape[1]):
                    tips = 1e3 * (recording.p[:, arm] - centre)
                    axis.plot(tips[:, i], tips[:, j], color=_COLOURS[arm], lw=0.8, alpha=0.6)
                    port = 1e3 * (recording.p_world_trocar[arm] - centre)
                    axis.plot(port[i], port[j], "x", color=shades["ink"], markersize=6)
            axis.set_title(f"{title}; x: trocars")
            axis.set_xlabel("x (mm)")
            axis.set_ylabel(label)
            axis.set_aspect("equal", adjustable="datalim")
    return figure


def over_time(recording: EpisodeMotion, arms: Sequence[MotionFigures], dark: bool = False) -> Any:
    """Draws depth, RCM error, speed, a wrist and jaws of one episode."""
    rows = [
        ("depth of the tip (mm)", lambda f: f.depth_mm),
        ("shaft off the trocar (mm)", lambda f: f.rcm_mm),
        ("speed of the tip (mm/s)", lambda f: f.speed_mm_s),
        ("jaws, -1 closed", lambda f: f.gripper),
    ]
    if arms[0].bend_deg is not None:
        rows.insert(3, ("wrist: pitch, yaw dashed (degrees)", lambda f: f.bend_deg))
    with style.use(dark):
        figure = style.figure(7.4, 1.3 * len(rows))
        axes = figure.subplots(len(rows), 1, sharex=True)
        for axis, (title, values) in zip(axes, rows):
            for i, one in enumerate(arms):
                y = values(one)
                t = np.arange(len(y)) / recording.hz
                for column, dashes in zip(y.reshape(len(y), -1).T, ("-", "--")):
                    axis.plot(t, column, dashes, color=_COLOURS[i], lw=1.2)
            axis.set_title(title)
            if "trocar" in title:
                axis.set_ylim(0, max(_LEAST_MM, axis.get_ylim()[1]))
        axes[-1].set_xlabel("time (s)")
    return figure


def spreads(
    found: Sequence[EpisodeMotion], arms: Sequence[Sequence[MotionFigures]], dark: bool = False
) -> Any:
    """Draws the distance of shafts from their trocars and the trocars' wander, by episode."""
    numbers = [recording.number for recording in found]
    panels = (
        ("shaft off the trocar (mm)", lambda f: f.rcm_mm),
        ("wander of the trocar (mm)", lambda f: f.wander_mm),
    )
    with style.use(dark):
        from matplotlib import ticker

        figure = style.figure(7.4, 2.8)
        axes = figure.subplots(1, len(panels))
        for axis, (title, values) in zip(axes, panels):
            for i in range(len(arms[0])):
                high = 99 if values(arms[0][i]) is arms[0][i].rcm_mm else 100
                drawn = [(n, values(a[i])) for n, a in zip(numbers, arms) if len(values(a[i]))]
                x = [n for n, _ in drawn]
                low = [float(np.median(v)) for _, v in drawn]
                top = [float(np.percentile(v, high)) for _, v in drawn]
                axis.vlines(x, low, top, color=_COLOURS[i], lw=1.2)
                axis.plot(x, low, "o", color=_COLOURS[i], markersize=3.5)
            if not axis.has_data():
                axis.text(
                    0.5, 0.5, "no window determines a trocar", transform=axis.transAxes, ha="center"
                )
                axis.set_xticks([])
            axis.set_title(title)
            axis.set_xlabel("episode")
            axis.set_ylim(0, max(_LEAST_MM, axis.get_ylim()[1]))
            if axis.has_data():
                axis.xaxis.set_major_locator(ticker.MaxNLocator(integer=True))
    return figure


def strip(images: np.ndarray) -> bytes:
    """Returns images `[n, h, w, 3]` uint8 side by side as PNG."""
    import matplotlib.image

    data = io.BytesIO()
    matplotlib.image.imsave(data, np.concatenate(list(images), axis=1), format="png")
    return data.getvalue()
