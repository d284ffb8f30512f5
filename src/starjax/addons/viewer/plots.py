"""The page's plots: RCM error over time; path of the tip, and its plan."""

import collections
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from starjax.addons.viewer.frame import Frame

if TYPE_CHECKING:  # for annotations alone
    import viser

COLOURS = ("#00796b", "#c2611f")  # colours of the first and the second rollout
_AXES = ("#c23b3b", "#3f8f3f", "#3b62c2")  # x, y, z, as 3D views colour them
_SPAN_S = 6.0
_HEIGHT = 190  # pixels
_MIN_TOP = 0.1  # mm, smallest top of the error axis
_X = {"time": False}
_PADDING = (12, 24, 0, 0)  # pixels; without the first, the top tick's label is cut


class Plots:
    """Two plots of one or two rollouts, extended frame by frame."""

    def __init__(self, gui: "viser.GuiApi", labels: Sequence[str], hz: float):
        self._hz, kept = hz, round(_SPAN_S * hz)
        self._frames = [collections.deque[Frame](maxlen=kept) for _ in labels]
        self._top = _MIN_TOP
        self._errors = _plot(gui, "RCM error (mm)", list(zip(labels, COLOURS)), (0.0, _MIN_TOP))
        self._paths = _plot(gui, "Tip (mm), then as planned", list(zip("xyz", _AXES)))

    def clear(self) -> None:
        """Clears the episode."""
        for frames in self._frames:
            frames.clear()

    def add(self, frames: Sequence[Frame]) -> None:
        """Adds one frame of each rollout."""
        for kept, frame in zip(self._frames, frames, strict=True):
            if not kept or kept[-1].step != frame.step:
                kept.append(frame)

    def draw(self) -> None:
        """Sends the curves."""
        longest = max(self._frames, key=len)
        if len(longest) < 2:
            return
        errors = [_held([f.rcm_error.max() for f in kept], len(longest)) for kept in self._frames]
        if (top := _rounded(1e3 * max(map(np.max, errors)))) != self._top:
            self._top, self._errors.scales = top, {"x": _X, "y": {"range": (0.0, top)}}
        times = np.array([f.step for f in longest]) / self._hz
        self._errors.data = (times, *(1e3 * error for error in errors))
        first = self._frames[0]
        path = [f.p_world_tip[0] for f in first] + list(first[-1].plan[:, 0])
        times = (np.arange(len(path)) - len(first) + 1) / self._hz
        self._paths.data = (times, *(1e3 * np.asarray(path, np.float64)).T)


def _plot(
    gui: Any,
    title: str,
    lines: Sequence[tuple[str, str]],
    y: tuple[float, float] | None = None,
) -> Any:
    """Adds an empty plot of lines (name, colour)."""
    blank = np.arange(2.0)
    series = ({"label": name, "stroke": colour, "width": 2} for name, colour in lines)
    return gui.add_uplot(
        (blank, *(0.0 * blank for _ in lines)),
        ({"label": "s"}, *series),
        title=title,
        height=_HEIGHT,
        scales={"x": _X, "y": {"range": y} if y else {"auto": True}},
        legend={"show": True, "live": False},
        padding=_PADDING,
    )


def _held(values: Sequence[float], length: int) -> np.ndarray:
    """Extends a rollout that ended earlier by its last value."""
    return np.array([*values, *[values[-1]] * (length - len(values))])


def _rounded(top: float) -> float:
    """Rounds up to 0.1, 0.2, 0.5, 1, 2, 5, ..."""
    power = 10.0 ** math.floor(math.log10(max(top, _MIN_TOP)))
    return next(power * step for step in (1, 2, 5, 10) if top <= power * step)
