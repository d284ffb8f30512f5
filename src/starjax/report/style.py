"""One look for every figure: colour-blind safe (Okabe-Ito), thin axes, on light or on dark paper.

Figures are made as `matplotlib.figure.Figure`, never through pyplot, so no backend is ever chosen.
"""

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from starjax import methods
from starjax.report import stats

SUCCESS, FAILURE = "#2083C5", "#D55E00"
# In the order of the methods' table, so that a method keeps its colour in every figure.
_METHODS = ("#D55E00", "#E69F00", "#CC79A7", "#8C6D4F", "#7F7F7F", "#56B4E9", "#009E73", "#2083C5")
_MARKERS = "sD^v<>Po"
_STROKES = ("-", "--", ":", "-.")
_LINE, _HANDLE = 110, 8  # characters in a line of a legend, and what a handle takes of them
MAP = "cividis"  # perceptually even, the same to every kind of colour vision

_LIGHT = {"ink": "#1d2329", "muted": "#6b7480", "line": "#d9dee3", "paper": "#ffffff"}
_DARK = {"ink": "#e6e9ec", "muted": "#98a2ad", "line": "#39424c", "paper": "#171b20"}


@contextmanager
def use(dark: bool = False) -> Iterator[dict[str, str]]:
    """Draws under the report's style; yields the shades `ink`, `muted`, `line` and `paper`."""
    import matplotlib

    shades = _DARK if dark else _LIGHT
    settings: Any = {
        "figure.facecolor": shades["paper"],
        "axes.facecolor": shades["paper"],
        "text.color": shades["ink"],
        "axes.labelcolor": shades["ink"],
        "axes.edgecolor": shades["muted"],
        "xtick.color": shades["muted"],
        "ytick.color": shades["muted"],
        "grid.color": shades["line"],
        "axes.grid": True,
        "axes.axisbelow": True,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.linewidth": 0.8,
        "grid.linewidth": 0.6,
        "lines.linewidth": 1.8,
        "font.size": 9.0,
        "axes.titlesize": 9.5,
        "axes.titlelocation": "left",
        "legend.frameon": False,
        "text.parse_math": False,  # a folder's name may hold dollars
    }
    with matplotlib.rc_context(settings):
        yield shades


def method(name: str) -> tuple[str, str]:
    """Colour and marker of a method."""
    index = list(methods.METHODS).index(name) % len(_METHODS)
    return _METHODS[index], _MARKERS[index]


def strokes(names: Sequence[str]) -> list[str]:
    """A line style for each of several runs of these methods, which share a method's colour."""
    return [_STROKES[names[:i].count(name) % len(_STROKES)] for i, name in enumerate(names)]


def rates(
    axis: Any,
    x: Sequence[float],
    scores: Sequence[stats.Rate],
    name: str,
    label: str,
    stroke: str = "-",
):
    """A method's rates at `x`: a line in its colour, with whiskers from low to high."""
    color, marker = method(name)
    middle = [score.rate for score in scores]
    ends = [[s.rate - s.low for s in scores], [s.high - s.rate for s in scores]]
    line = {"color": color, "linewidth": 1.2, "linestyle": stroke}
    axis.plot(x, middle, marker=marker, markersize=4, label=label, **line)
    axis.errorbar(x, middle, ends, color=color, linewidth=0.8, linestyle="")


def legend(
    figure: Any,
    handles: Sequence[Any],
    labels: Sequence[str],
    side: str = "center",
    most: int = 4,
    **settings: Any,
) -> None:
    """A legend below the figure, of as many columns as its longest label leaves room for."""
    columns = max(1, min(most, _LINE // (_HANDLE + max(map(len, labels), default=0))))
    place = {"loc": f"outside lower {side}", "fontsize": 7, "ncols": columns}
    figure.legend(handles, labels, **place, **settings)


def save(figure: Any, kind: str) -> bytes:
    """The figure as the bytes of a png or a pdf file, the same bytes for the same figure."""
    import matplotlib

    stream = io.BytesIO()
    meta = {"CreationDate": None} if kind == "pdf" else {"Software": None}
    with matplotlib.rc_context({"pdf.fonttype": 42}):  # text stays text, as journals ask
        figure.savefig(stream, format=kind, dpi=180, metadata=meta)
    return stream.getvalue()


def percent_axis(axis: Any) -> None:
    """Makes a y axis of fractions read 0-100%."""
    axis.set_ylim(-0.03, 1.03)
    axis.set_yticks([0, 0.25, 0.5, 0.75, 1], ["0", "25", "50", "75", "100%"])
