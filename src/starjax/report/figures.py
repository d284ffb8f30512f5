"""Fig. 4 (success against distance from the training trocars, map of the disc) and loss curves."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from starjax.evaluation import rate_map
from starjax.evaluation.result import Trial
from starjax.report import captions, compare, outcomes, results, stats, style

if TYPE_CHECKING:  # for annotations alone
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BIN = 0.005  # m of distance pooled in one point
_DISC = 0.05  # m, radius of Eq. 19's disc
_LABEL_OFFSET = (5, 4)  # points from a dot to its label
_MIN_PANELS = 2  # panels across the page: a single one would fill it


def distance(runs: Sequence[results.Run], focus: results.Run, dark: bool = False) -> Any:
    """Draws Fig. 4: success against distance to the nearest training trocar, and `focus`'s map."""
    with style.use(dark) as shades:
        figure = style.figure(7.4, 3.4)
        left, right = figure.subplots(1, 2, width_ratios=[1.3, 1])
        strokes = style.strokes([run.result.method for run in runs])
        for i, run in enumerate(runs):
            if len(runs) == 1:
                _dots(left, run, shades)
            else:
                _whiskers(left, run, (i - (len(runs) - 1) / 2) * 0.35, strokes[i])
        left.set_xlabel("distance to the nearest training trocar (mm)")
        left.set_ylabel("success rate, 95% Wilson interval")
        name = focus.label if len(runs) == 1 else captions.several(runs)
        left.set_title(f"{name} from {compare.observed(runs)}")
        style.percent_axis(left)
        if len(runs) > 1:
            style.legend(figure, *left.get_legend_handles_labels(), side="left")
        _disc(figure, right, focus, shades)
    return figure


def training(runs: Sequence[results.Run], dark: bool = False) -> Any | None:
    """Draws training loss and held-out action error against steps; None if nothing was logged.

    Methods that share their weights share a curve.
    """
    runs = list({run.log: run for run in reversed(runs) if run.curves}.values())[::-1]
    panels = [
        (name, title)
        for name, title in CURVES.items()
        if any(name in line for run in runs for line in run.curves)
    ]
    if not panels:
        return None
    with style.use(dark):
        from matplotlib import ticker

        figure = style.figure(2.6 * max(len(panels), _MIN_PANELS), 2.4)
        strokes = style.strokes([run.result.method for run in runs])
        shape = (1, max(len(panels), _MIN_PANELS))
        (grid,) = figure.subplots(*shape, squeeze=False, sharex=True)
        for unused in grid[len(panels) :]:
            unused.set_visible(False)
        for axis, (name, title) in zip(grid, panels):
            for run, stroke in zip(runs, strokes):
                points = [(line["step"], line[name]) for line in run.curves if name in line]
                color, _ = style.method(run.result.method)
                if points:
                    line = {"color": color, "linewidth": 1.3, "linestyle": stroke}
                    line |= {"marker": "o"} if len(points) == 1 else {}  # else it would not show
                    axis.plot(*np.array(points).T, label=run.label, **line)
            axis.set_title(title)
            axis.set_xlabel(f"training step (from {compare.observed(runs)})")
            lines = (line for run in runs for line in run.curves)
            if not any(line.get(name, 0.0) > 0.0 for line in lines):
                continue  # such as the roll of reach, which is always right
            axis.set_yscale("log")
            low, high = axis.get_ylim()
            subs = _TICKS if high > _TICKS[-1] * low else _CLOSE_TICKS
            axis.yaxis.set_major_locator(ticker.LogLocator(subs=subs))
            axis.yaxis.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value:g}"))
            axis.yaxis.set_minor_locator(ticker.NullLocator())
        if len(runs) > 1:
            style.legend(figure, *axis.get_legend_handles_labels())
    return figure


# Ticks of each decade of a logarithmic axis, and of an axis too short for them.
_TICKS = (1, 2, 5)
_CLOSE_TICKS = (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8)

# Keys of metrics.jsonl that are drawn.
CURVES = {
    "loss": "Training loss",
    "position_error_mm": "Held-out position error (mm)",
    "roll_error_deg": "Held-out roll error (deg)",
}


def _pooled(run: results.Run) -> list[tuple[float, stats.Rate]]:
    """Pools trials by distance; returns (mean distance in mm, rate) per bin."""
    swept = run.sweep.trials if run.sweep else ()
    alike = not run.sweep or results.sweep_limit_s(run) == run.limit_s
    trials = [*(run.trials if alike else ()), *swept]
    apart = outcomes.distances(trials, results.training_trocars(run))
    bins = np.round(apart / _BIN).astype(int)
    inside = [np.flatnonzero(bins == b) for b in np.unique(bins)]
    return [(1e3 * apart[i].mean(), outcomes.tally(trials[j] for j in i)) for i in inside]


def _dots(axis: "Axes", run: results.Run, shades: dict[str, str]) -> None:
    """Draws one method: pooled rates as dots with intervals and counts, single trocars faintly."""
    points, color = _pooled(run), style.SUCCESS
    x, scores = [at for at, _ in points], [score for _, score in points]
    if not run.sweep:
        groups = outcomes.by_trocar(run.trials)
        apart = outcomes.distances([g[0] for g in groups], results.training_trocars(run))
        rates = [outcomes.tally(g).rate for g in groups]
        axis.plot(1e3 * apart, rates, "o", color=color, alpha=0.35, markersize=4)
    ends = [[s.rate - s.low for s in scores], [s.high - s.rate for s in scores]]
    rates = [score.rate for score in scores]
    axis.errorbar(x, rates, ends, fmt="o", color=color, markersize=5, linewidth=1.0)
    for at, score in points:
        offset = {"xytext": _LABEL_OFFSET, "textcoords": "offset points"}
        axis.annotate(
            f"n {score.trials}", (at, score.rate), fontsize=6.5, color=shades["muted"], **offset
        )


def _whiskers(axis: "Axes", run: results.Run, offset: float, stroke: str) -> None:
    """Draws one of several methods: a line with whiskers, shifted by `offset` mm."""
    points = _pooled(run)
    x, scores = [at + offset for at, _ in points], [score for _, score in points]
    style.rates(axis, x, scores, run.result.method, run.label, stroke)


def _disc(figure: "Figure", axis: "Axes", run: results.Run, shades: dict[str, str]) -> None:
    """Draws trocars from above: a smoothed map of a sweep, else a dot per trocar."""
    groups = outcomes.by_trocar(run.sweep.trials if run.sweep else run.trials)
    arms = len(groups[0][0].radius)
    at = _from_above([group[0] for group in groups])
    rates = np.repeat([outcomes.tally(group).rate for group in groups], arms)
    if run.sweep:
        shown = _heat(axis, at, rates, np.repeat([len(group) for group in groups], arms))
        axis.plot(*at.T, ".", color=shades["ink"], markersize=1.6, alpha=0.4)
        ports = _from_above(results.training_trocars(run))
        axis.plot(*ports.T, "x", color=style.FAILURE, markersize=6, label="training trocar")
        axis.legend(loc="upper left", bbox_to_anchor=(0, -0.12), fontsize=7)
    else:
        colours = [shades["ink"] if group[0].seen else style.FAILURE for group in groups]
        edge = np.repeat(colours, arms).tolist()
        shown = axis.scatter(
            *at.T, c=rates, cmap=style.MAP, vmin=0, vmax=1, s=330, edgecolors=edge, linewidths=1.6
        )
        for (x, y), value in zip(at, rates):
            ink = "black" if value > 0.5 else "white"
            axis.text(x, y, f"{100 * value:.0f}", ha="center", va="center", fontsize=7, color=ink)
        axis.text(
            0, -1.5e3 * _DISC, "orange rim: unseen", ha="center", fontsize=7, color=style.FAILURE
        )
    turn = np.linspace(0, 2 * np.pi, 181)
    axis.plot(1e3 * _DISC * np.cos(turn), 1e3 * _DISC * np.sin(turn), color=shades["muted"], lw=0.8)
    axis.set_aspect("equal")
    axis.grid(False)
    axis.set_title(f"by trocar, from above (mm)\n{run.label}", fontsize=8)
    bar = figure.colorbar(shown, ax=axis, shrink=0.8, ticks=[0, 0.5, 1])
    bar.ax.set_yticklabels(["0", "50", "100%"])
    bar.outline.set_visible(False)


def _from_above(trials: Sequence[Trial]) -> np.ndarray:
    """Returns trocars `[N * A, 2]` in mm, relative to the nominal trocar of their arm."""
    return 1e3 * outcomes.positions(trials)[..., :2].reshape(-1, 2)


def _heat(axis: "Axes", at: np.ndarray, rates: np.ndarray, weights: np.ndarray) -> Any:
    """Draws the kernel mean of `rates [N]` at `at [N, 2]` mm, weighted by trials."""
    line = np.linspace(-_DISC, _DISC, 161)
    mean = rate_map.around(line, line, 1e-3 * at, rates, weights)
    mean[np.hypot(*np.meshgrid(line, line)) > _DISC] = np.nan
    edges = tuple(1e3 * line[i] for i in (0, -1, 0, -1))
    return axis.imshow(mean, extent=edges, origin="lower", cmap=style.MAP, vmin=0, vmax=1)
