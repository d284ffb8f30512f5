"""Fig. 3: tip paths through several trocars over the task's outline, in an orthographic view.

The scene is flat shapes in a fixed view: 2-D artists in painter's order draw it sharper than a
3-D axis.
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from starjax.evaluation import paired
from starjax.report import compare, outcomes, results, style
from starjax.report.scene_view import SceneView
from starjax.sim.names import SceneNames
from starjax.sim.task import Outline

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Stages = Callable[[SceneNames], SceneView]

_AZIMUTH, _ELEVATION = np.deg2rad(-52.0), np.deg2rad(20.0)
_RIGHT = np.array([-np.sin(_AZIMUTH), np.cos(_AZIMUTH), 0.0])
_BACK = np.array(
    [
        np.cos(_AZIMUTH) * np.cos(_ELEVATION),
        np.sin(_AZIMUTH) * np.cos(_ELEVATION),
        np.sin(_ELEVATION),
    ]
)
_VIEW = np.stack([_RIGHT, np.cross(_BACK, _RIGHT)], -1)  # [3, 2]
_COLUMNS = 3
_FAN = 14  # shafts drawn along a path
_MARGIN = 0.004  # m around the task's areas
_BEYOND = 0.02  # m of shaft drawn above the trocar
_ABOVE = np.array([0.0, 0.0, _BEYOND + 2e-3])  # m, of a panel above its trocars
_ROOM = 0.03  # m around areas and trocars; paths beyond are cut off


def draw(runs: Sequence[results.Run], stages: Stages, dark: bool = False) -> Any | None:
    """Draws Fig. 3; None if no run recorded a rollout.

    Top row seen, bottom row unseen, a configuration of trocars a panel, their places marked with
    crosses. One run: blue paths succeeded, orange ones failed. Several: a colour a method, failures
    dashed. Shafts are those of the recorded joints.
    """
    runs = [run for run in runs if run.rollouts]
    rows = [row for row in (_panels(runs, True), _panels(runs, False)) if row]
    if not rows:
        return None
    columns = max(len(row) for row in rows)
    outline = stages(runs[0].result.scene).outline
    frame = _frame(outline, runs)
    with style.use(dark) as shades:
        figure = style.figure(2.6 * columns, 3.5 * len(rows) + 0.3)
        grid = figure.subplots(len(rows), columns, squeeze=False)
        for axes, row in zip(grid, rows):
            for axis in axes[len(row) :]:
                axis.set_visible(False)
            for axis, index in zip(axes, row):
                _areas(axis, outline, shades)
                _panel(axis, runs, index, stages, shades, outline.ground)
                axis.set_xlim(frame[0])
                axis.set_ylim(frame[1])
        _scale_bar(grid[0, 0], frame, shades)
        handles = _legend(runs, shades)
        labels = [handle.get_label() for handle in handles]
        title = {"title": _title(runs), "title_fontsize": 8}
        style.legend(figure, handles, labels, max_columns=len(handles), **title)
    return figure


def _panels(runs: Sequence[results.Run], seen: bool) -> list[int]:
    """Selects up to three trocars spread over those that most methods recorded."""
    counts: dict[int, int] = {}
    for run in runs:
        for index in {r.trial.trocar for r in run.rollouts if r.trial.seen == seen}:
            counts[index] = counts.get(index, 0) + 1
    shared = sorted(index for index in counts if counts[index] == max(counts.values()))
    picks = np.linspace(0, len(shared) - 1, min(_COLUMNS, len(shared))).round().astype(int)
    return [shared[i] for i in picks]


def _panel(
    axis: "Axes",
    runs: Sequence[results.Run],
    index: int,
    stages: Stages,
    shades: dict[str, str],
    ground: float,
) -> None:
    """Draws a trocar configuration: paths with their shafts, and the trocars."""
    drawn = [(i, r) for i, run in enumerate(runs) for r in run.rollouts if r.trial.trocar == index]
    if len(runs) > 1:  # one trial for all methods: their paths compare
        shared = compare.most_shared(r.trial for _, r in drawn)
        drawn = [(i, r) for i, r in drawn if paired.identity(r.trial) == shared]
    trial, trocars = drawn[0][1].trial, drawn[0][1].p_world_trocar
    kind, (r, polar, azimuth) = "Seen" if trial.seen else "Unseen", outcomes.place(trial)
    axis.set_title(f"{kind} trocar {index}\nr {r}, θ {polar}, φ {azimuth}", fontsize=8)
    for i, rollout in drawn:
        won = outcomes.strict(rollout.trial)
        color, _ = style.method(runs[i].result.method)
        dashed = len(runs) > 1 and not won
        if len(runs) == 1:
            color = style.SUCCESS if won else style.FAILURE
        if rollout is drawn[-1][1] and rollout.qpos is not None:
            _shafts(axis, rollout, color, stages(runs[i].result.scene))
        for tip in rollout.p_world_tip.swapaxes(0, 1):
            _path(axis, tip, won, color, dashed, shades, ground)
    for trocar in trocars:
        cross = {"color": shades["ink"], "markersize": 9, "markeredgewidth": 2, "zorder": 9}
        axis.plot(*_flat(trocar), "x", **cross)


def _areas(axis: "Axes", outline: Outline, shades: dict[str, str]) -> None:
    axis.set_axis_off()
    axis.set_aspect("equal")
    face, edge = shades["line"], shades["muted"]
    for area in outline.areas:
        axis.fill(*_flat(area).T, facecolor=face, edgecolor=edge, linewidth=0.6, alpha=0.6)
    for line in outline.lines:
        thick = {"linewidth": 2.0, "solid_capstyle": "round", "zorder": 2}
        axis.plot(*_flat(line).T, color=shades["muted"], **thick)


def _path(
    axis: "Axes",
    tip: np.ndarray,
    won: bool,
    color: str,
    dashed: bool,
    shades: dict[str, str],
    ground: float,
) -> None:
    """Draws the path `[T, 3]` m of one tip with its shadow, start and end."""
    below = np.concatenate([tip[:, :2], np.full((len(tip), 1), ground)], axis=-1)
    axis.plot(*_flat(below).T, color=shades["muted"], linewidth=1.0, alpha=0.4, zorder=1)
    flat = _flat(tip)
    axis.plot(*flat.T, color=color, linewidth=1.4, linestyle="--" if dashed else "-", zorder=5)
    axis.plot(*flat[0], "o", color=color, markersize=4, markerfacecolor="none", zorder=6)
    axis.plot(*flat[-1], "o" if won else "s", color=color, markersize=5, zorder=7)


def _shafts(axis: "Axes", rollout: results.TrialTrajectory, color: str, scene: SceneView) -> None:
    """Draws the shafts along a rollout, from the tips to beyond the trocars.

    A wrist is drawn as a line from the shaft's end to the tip.
    """
    assert rollout.qpos is not None
    rows = np.linspace(0, len(rollout.qpos) - 1, _FAN).round().astype(int)
    p, end, axis_of_shaft = scene.shafts(rollout.qpos[rows], rollout.p_world_trocar)
    length = np.linalg.norm(rollout.p_world_trocar - end, axis=-1) + _BEYOND  # [T, A]
    lines = [end - length[..., None] * axis_of_shaft, end]
    if not np.array_equal(p, end):
        lines.append(p)
    for shaft in np.stack(lines).reshape(len(lines), -1, 3).swapaxes(0, 1):
        axis.plot(*_flat(shaft).T, color=color, linewidth=0.6, alpha=0.34)


def _title(runs: Sequence[results.Run]) -> str:
    if len(runs) == 1:
        return f"{runs[0].label}, from {compare.observed(runs)}"
    return f"policies that see the {compare.observed(runs)}"


def _frame(outline: Outline, runs: Sequence[results.Run]) -> tuple[tuple[float, float], ...]:
    """Returns limits, shared by all panels, of areas, trocars and the paths near them."""
    rollouts = [rollout for run in runs for rollout in run.rollouts]
    above = [rollout.p_world_trocar + _ABOVE for rollout in rollouts]
    fixed = [*(_flat(area) for area in outline.areas), *(_flat(trocar) for trocar in above)]
    fixed = np.concatenate(fixed)
    paths = _flat(np.concatenate([rollout.p_world_tip.reshape(-1, 3) for rollout in rollouts]))
    start, end = fixed.min(0) - _MARGIN, fixed.max(0) + _MARGIN
    low = np.minimum(start, np.maximum(paths.min(0), start - _ROOM))
    high = np.maximum(end, np.minimum(paths.max(0), end + _ROOM))
    return tuple((float(a), float(b)) for a, b in zip(low, high))


def _scale_bar(
    axis: "Axes", frame: tuple[tuple[float, float], ...], shades: dict[str, str]
) -> None:
    x, y = frame[0][0], frame[1][0] + 0.002
    axis.plot([x, x + 0.02], [y, y], color=shades["muted"], linewidth=1.6, solid_capstyle="butt")
    axis.text(x + 0.01, y + 0.002, "20 mm", ha="center", fontsize=7, color=shades["muted"])


def _legend(runs: Sequence[results.Run], shades: dict[str, str]) -> list[Any]:
    from matplotlib.lines import Line2D

    def line(color: str, label: str, **kwargs: Any) -> Any:
        return Line2D([], [], color=color, label=label, **kwargs)

    cross = line(shades["ink"], "trocar", marker="x", linestyle="", markeredgewidth=2)
    if len(runs) == 1:
        won = line(style.SUCCESS, "success", marker="o", markersize=4)
        lost = line(style.FAILURE, "failure", marker="s", markersize=4)
        return [won, lost, cross]
    colors = [line(style.method(run.result.method)[0], run.label) for run in runs]
    lost = line(shades["muted"], "failure", linestyle="--", marker="s", markersize=4)
    return [*colors, lost, cross]


def _flat(points: np.ndarray) -> np.ndarray:
    """Projects world points `[..., 3]` m to the drawing's plane `[..., 2]` m."""
    return np.asarray(points) @ _VIEW
