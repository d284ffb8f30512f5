"""The page of a recorded dataset: `starjax inspect DATASET --page`."""

import statistics
import types
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from starjax.addons.viewer import recording_figures
from starjax.data import recordings
from starjax.data.recordings import EpisodeMotion, MotionFigures
from starjax.report import formats, page, style
from starjax.report.formats import Table
from starjax.report.sections import Card

_ROWS = 30  # episodes in the table


def render(
    title: str,
    rows: Sequence[tuple[str, str]],
    found: Sequence[EpisodeMotion],
    odd: Sequence[str],
    images: Mapping[str, np.ndarray] = types.MappingProxyType({}),
) -> str:
    """Renders the page.

    Args:
      title: of the dataset.
      rows: names and texts of the summary.
      found: motions of its episodes, at least one.
      odd: anomalies, one per line.
      images: `[n, h, w, 3]` uint8 of an episode by camera, shown side by side.
    """
    arms = [[recordings.figures(r, i) for i in range(r.p.shape[1])] for r in found]
    longest = int(np.argmax([len(r.p) for r in found]))
    drawn: dict[str, Callable[[bool], Any]] = {
        "paths": lambda dark: recording_figures.paths(found, dark),
        "time": lambda dark: recording_figures.over_time(found[longest], arms[longest], dark),
        "spreads": lambda dark: recording_figures.spreads(found, arms, dark),
    }
    figures = {
        name: (style.save(draw(False), "png"), style.save(draw(True), "png", dark=True))
        for name, draw in drawn.items()
    }
    return (
        page.environment()
        .get_template("recording.html")
        .render(
            title=title,
            rows=[(name.strip(), text) for name, text in rows if not name.startswith("  ")],
            columns=[("column", "content")]
            + [(name.strip(), text) for name, text in rows if name.startswith("  ")],
            cards=cards(found, arms),
            odd=odd,
            figures=figures,
            strips={camera: recording_figures.strip(x) for camera, x in images.items()},
            shown=found[longest].number,
            count=len(found),
            episodes=table(found, arms),
        )
    )


def cards(found: Sequence[EpisodeMotion], arms: Sequence[Sequence[MotionFigures]]) -> list[Card]:
    """Returns the headline numbers over all episodes and arms."""
    every = [one for of_episode in arms for one in of_episode]
    rcm, speed = (
        np.concatenate([getattr(one, name) for one in every]) for name in ("rcm_mm", "speed_mm_s")
    )
    depth = np.concatenate([one.depth_mm for one in every])
    wander = np.concatenate([one.wander_mm for one in every])
    _, off = recordings.spread(rcm)
    fast = float(np.percentile(speed, 95)) if len(speed) else 0.0
    seconds = sum(len(r.p) / r.hz for r in found)
    closings = sum(one.closings for one in every)
    places = np.unique(np.round([r.p_world_trocar for r in found], 3), axis=0)
    texts = [
        Card("Trocars", str(len(places)), "", f"configurations in {len(found)} episodes"),
        Card("Shaft off the trocar", formats.millimetres(off), " mm", "99th percentile of steps"),
        Card("Reach", f"{depth.min():.0f} to {depth.max():.0f}", " mm", "tip below the trocar"),
        Card("Speed of the tip", f"{fast:.0f}", " mm/s", "95th percentile of steps"),
        Card("Jaws", str(closings), " closings", f"in {seconds:.0f} s of {len(found)} episodes"),
    ]
    bends = [one.bend_deg for one in every if one.bend_deg is not None]
    if bends:
        low, high = np.min([b.min() for b in bends]), np.max([b.max() for b in bends])
        texts.append(Card("Wrist", f"{low:.0f} to {high:.0f}", " degrees", "pitch and yaw"))
    if len(wander):
        middle, most = map(formats.millimetres, (statistics.median(wander), wander.max()))
        more = f"median of {len(wander)} windows of 5 s; {most} mm at most"
        texts.insert(1, Card("Wander of the trocar", middle, " mm", more))
    return texts


def table(found: Sequence[EpisodeMotion], arms: Sequence[Sequence[MotionFigures]]) -> Table:
    """Returns a row per episode and arm."""
    header = ("episode", "arm", "split", "s", "trocar (mm)", "off, p99 (mm)", "wander (mm)")
    rows: Table = [[*header, "depth (mm)", "speed, max (mm/s)", "closings"]]
    for recording, of_episode in list(zip(found, arms))[:_ROWS]:
        for i, one in enumerate(of_episode):
            place = ", ".join(f"{1e3 * x:.0f}" for x in recording.p_world_trocar[i])
            fast = one.speed_mm_s.max() if len(one.speed_mm_s) else 0.0
            wander = formats.millimetres(one.wander_mm.max()) if len(one.wander_mm) else "–"
            split = recording.split or ("" if recording.success else "failure")
            seconds = f"{len(one.rcm_mm) / recording.hz:.1f}"
            off = formats.millimetres(recordings.spread(one.rcm_mm)[1])
            depth = f"{one.depth_mm.min():.0f} to {one.depth_mm.max():.0f}"
            texts = [str(recording.number), str(i), split, seconds, place, off, wander, depth]
            rows.append([*texts, f"{fast:.0f}", str(one.closings)])
    return rows
