"""One look for every figure: colour-blind safe (Okabe-Ito), thin axes, on light or on dark paper.

Figures never pass through pyplot, and are made and saved with matplotlib's own defaults under the
report's settings: neither the user's backend nor a matplotlibrc changes a byte of them.
"""

import importlib
import io
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import ModuleType
from typing import TYPE_CHECKING, Any

from starjax.core import methods
from starjax.report import stats

if TYPE_CHECKING:  # for annotations alone
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SUCCESS, FAILURE = "#2083C5", "#D55E00"
# In the order of the methods' table: a method keeps its colour in every figure.
_METHODS = (
    *("#D55E00", "#E69F00", "#CC79A7", "#8C6D4F", "#7F7F7F", "#56B4E9", "#009E73", "#2083C5"),
    "#7A5FB5",
)
_MARKERS = "sD^v<>PoX"
_STROKES = ("-", "--", ":", "-.")
_LINE, _HANDLE = 110, 8  # characters in a line of a legend, and width of a handle
MAP = "cividis"  # perceptually uniform, colour-blind safe

_LIGHT = {"ink": "#1d2329", "muted": "#6b7480", "line": "#d9dee3", "paper": "#ffffff"}
_DARK = {"ink": "#e6e9ec", "muted": "#98a2ad", "line": "#39424c", "paper": "#171b20"}


_DPI = 180  # for a png

_SETTINGS: dict[str, Any] = {
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
    "pdf.fonttype": 42,  # text stays text, as journals ask
    "text.parse_math": False,  # a folder's name may hold dollars
}


def library() -> ModuleType:
    """Imports matplotlib, even where its environment variables or matplotlibrc prevent it."""
    try:
        return importlib.import_module("matplotlib")
    except ValueError:  # an unknown MPLBACKEND, a matplotlibrc that is not text
        for name in [name for name in sys.modules if name.startswith("matplotlib.")]:
            del sys.modules[name]  # partly imported modules
        kept = dict(os.environ)
        os.environ |= {"MPLBACKEND": "agg", "MATPLOTLIBRC": os.devnull}
        try:
            return importlib.import_module("matplotlib")
        finally:
            os.environ.clear()
            os.environ |= kept


@contextmanager
def use(dark: bool = False) -> Iterator[dict[str, str]]:
    """Draws under the report's style; yields the shades `ink`, `muted`, `line` and `paper`."""
    matplotlib = library()
    shades = _DARK if dark else _LIGHT
    colours = {
        "figure.facecolor": shades["paper"],
        "axes.facecolor": shades["paper"],
        "text.color": shades["ink"],
        "axes.labelcolor": shades["ink"],
        "axes.edgecolor": shades["muted"],
        "xtick.color": shades["muted"],
        "ytick.color": shades["muted"],
        "grid.color": shades["line"],
    }
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update({**_SETTINGS, **colours})
        yield shades


def figure(width: float, height: float) -> Any:
    """Makes an empty figure of a size in inches; called within `use`."""
    from matplotlib.figure import Figure

    return Figure((width, height), layout="constrained")


def method(name: str) -> tuple[str, str]:
    """Returns colour and marker of a method; colours repeat with another marker."""
    turn, index = divmod(list(methods.SCORED).index(name), len(_METHODS))
    return _METHODS[index], _MARKERS[(index + turn) % len(_MARKERS)]


def strokes(names: Sequence[str]) -> list[str]:
    """Returns line styles that distinguish runs of one method, which share its colour."""
    return [_STROKES[names[:i].count(name) % len(_STROKES)] for i, name in enumerate(names)]


def rates(
    axis: "Axes",
    x: Sequence[float],
    scores: Sequence[stats.Rate],
    name: str,
    label: str,
    stroke: str = "-",
):
    """Draws a method's rates at `x`: a line in its colour, with whiskers from low to high."""
    color, marker = method(name)
    middle = [score.rate for score in scores]
    ends = [[s.rate - s.low for s in scores], [s.high - s.rate for s in scores]]
    line = {"color": color, "linewidth": 1.2, "linestyle": stroke}
    axis.plot(x, middle, marker=marker, markersize=4, label=label, **line)
    axis.errorbar(x, middle, ends, color=color, linewidth=0.8, linestyle="")


def legend(
    figure: "Figure",
    handles: Sequence[Any],
    labels: Sequence[str],
    side: str = "center",
    max_columns: int = 4,
    **settings: Any,
) -> None:
    """Adds a legend below the figure, with as many columns as its longest label permits."""
    columns = max(1, min(max_columns, _LINE // (_HANDLE + max(map(len, labels), default=0))))
    place = {"loc": f"outside lower {side}", "fontsize": 7, "ncols": columns}
    figure.legend(handles, labels, **place, **settings)


def save(figure: "Figure", kind: str, dark: bool = False) -> bytes:
    """Saves a figure as bytes of a png or pdf file, reproducible to the byte.

    Args:
      figure: drawn under `use(dark)`.
      kind: `png` or `pdf`.
      dark: style of the ticks, which are made when a figure is saved.
    """
    with use(dark):
        from matplotlib.backends import backend_agg, backend_pdf

        canvases = {"png": backend_agg.FigureCanvasAgg, "pdf": backend_pdf.FigureCanvasPdf}
        stream = io.BytesIO()
        meta = {"CreationDate": None} if kind == "pdf" else {"Software": None}
        canvases[kind](figure).print_figure(stream, format=kind, dpi=_DPI, metadata=meta)
    return stream.getvalue()


def percent_axis(axis: "Axes") -> None:
    """Makes a y axis of fractions read 0-100%."""
    axis.set_ylim(-0.03, 1.03)
    axis.set_yticks([0, 0.25, 0.5, 0.75, 1], ["0", "25", "50", "75", "100%"])
