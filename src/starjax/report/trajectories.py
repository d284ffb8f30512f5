"""Fig. 3: tip paths over the boards through several trocars, drawn in an orthographic view.

The scene is flat shapes in a fixed view, so plain 2-D artists in painter's order draw it sharper
than a 3-D axis would.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from starjax.report import outcomes, results, style
from starjax.sim.scene import TCP, SimModel
from starjax.sim.tasks.peg_transfer import task
from starjax.types import Pose

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
_MARGIN = 0.014  # m of board beyond the outer pegs
_BEYOND = 0.02  # m of shaft drawn above the trocar
_ROOM = 0.03  # m around boards and trocars that panels show: tools that fly off leave them


def draw(runs: Sequence[results.Run], sim: SimModel, dark: bool = False) -> Any | None:
    """Fig. 3, or None if no run recorded a rollout.

    Top row seen, bottom row unseen, a trocar a panel, its place marked with a cross. One run: blue
    paths succeeded, orange ones failed. Several: a colour a method, failures dashed. Shafts are
    those of the recorded joints.
    """
    pegs = sim.pegs
    runs = [run for run in runs if run.rollouts]
    rows = [row for row in (_panels(runs, True), _panels(runs, False)) if row]
    if not rows:
        return None
    columns = max(len(row) for row in rows)
    frame = _frame(pegs, runs)
    with style.use(dark) as shades:
        figure = style.figure(2.6 * columns, 3.5 * len(rows) + 0.3)
        grid = figure.subplots(len(rows), columns, squeeze=False)
        for axes, row in zip(grid, rows):
            for axis in axes[len(row) :]:
                axis.set_visible(False)
            for axis, index in zip(axes, row):
                _panel(axis, runs, index, sim, shades)
                axis.set_xlim(frame[0])
                axis.set_ylim(frame[1])
        _scale_bar(grid[0, 0], frame, shades)
        handles = _legend(runs, shades)
        labels = [handle.get_label() for handle in handles]
        title = {"title": _title(runs), "title_fontsize": 8}
        style.legend(figure, handles, labels, most=len(handles), **title)
    return figure


def _panels(runs: Sequence[results.Run], seen: bool) -> list[int]:
    """Up to three trocars spread over those recorded, the ones most methods recorded first."""
    counts: dict[int, int] = {}
    for run in runs:
        for index in {int(r.trial["trocar"]) for r in run.rollouts if r.trial["seen"] == seen}:
            counts[index] = counts.get(index, 0) + 1
    shared = sorted(index for index in counts if counts[index] == max(counts.values()))
    picks = np.linspace(0, len(shared) - 1, min(_COLUMNS, len(shared))).round().astype(int)
    return [shared[i] for i in picks]


def _panel(
    axis: Any, runs: Sequence[results.Run], index: int, sim: SimModel, shades: dict[str, str]
) -> None:
    """One trocar: boards, pegs, paths with their shafts, the trocar."""
    drawn = [
        (i, r) for i, run in enumerate(runs) for r in run.rollouts if r.trial["trocar"] == index
    ]
    if len(runs) > 1:  # the same trial for every method, so that the paths can be compared
        shared = results.most_shared(r.trial for _, r in drawn)
        drawn = [(i, r) for i, r in drawn if results.identity(r.trial) == shared]
    trial, trocar = drawn[0][1].trial, drawn[0][1].p_world_trocar
    axis.set_axis_off()
    axis.set_aspect("equal")
    kind, (r, polar, azimuth) = "Seen" if trial["seen"] else "Unseen", outcomes.place(trial)
    axis.set_title(f"{kind} trocar {index}\nr {r}, θ {polar}, φ {azimuth}", fontsize=8)
    _boards(axis, sim.pegs, shades)
    for i, rollout in drawn:
        won = outcomes.strict(rollout.trial)
        color, _ = style.method(runs[i].result["method"])
        dashed = len(runs) > 1 and not won
        if len(runs) == 1:
            color = style.SUCCESS if won else style.FAILURE
        if rollout is drawn[-1][1] and rollout.qpos is not None:
            _shafts(axis, rollout, rollout.qpos, color, sim)
        _path(axis, rollout, color, dashed, shades)
    axis.plot(*_flat(trocar), "x", color=shades["ink"], markersize=9, markeredgewidth=2, zorder=9)


def _boards(axis: Any, pegs: np.ndarray, shades: dict[str, str]) -> None:
    half = len(pegs) // 2
    for board in (pegs[:half], pegs[half:]):
        low, high = board.min(0) - _MARGIN, board.max(0) + _MARGIN
        corners = [(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])]
        face = _flat(np.array([[x, y, 0.0] for x, y in corners]))
        axis.fill(
            *face.T, facecolor=shades["line"], edgecolor=shades["muted"], linewidth=0.6, alpha=0.6
        )
    for x, y in pegs:
        stick = _flat(np.array([[x, y, 0.0], [x, y, task.PEG_HEIGHT]]))
        axis.plot(*stick.T, color=shades["muted"], linewidth=2.0, solid_capstyle="round", zorder=2)


def _path(
    axis: Any,
    rollout: results.Rollout,
    color: str,
    dashed: bool,
    shades: dict[str, str],
) -> None:
    tip = rollout.p_world_tip
    shadow = _flat(tip * np.array([1.0, 1.0, 0.0]))
    axis.plot(*shadow.T, color=shades["muted"], linewidth=1.0, alpha=0.4, zorder=1)
    flat = _flat(tip)
    axis.plot(*flat.T, color=color, linewidth=1.4, linestyle="--" if dashed else "-", zorder=5)
    axis.plot(*flat[0], "o", color=color, markersize=4, markerfacecolor="none", zorder=6)
    end = "o" if outcomes.strict(rollout.trial) else "s"
    axis.plot(*flat[-1], end, color=color, markersize=5, zorder=7)


def _shafts(
    axis: Any, rollout: results.Rollout, qpos: np.ndarray, color: str, sim: SimModel
) -> None:
    """The shaft at moments of a rollout, from the tip to beyond the trocar."""
    for pose in _poses(sim, qpos[np.linspace(0, len(qpos) - 1, _FAN).round().astype(int)]):
        length = np.linalg.norm(rollout.p_world_trocar - pose.p) + _BEYOND
        ends = np.stack([pose.p - length * pose.R[:, 2], pose.p])
        axis.plot(*_flat(ends).T, color=color, linewidth=0.6, alpha=0.34)


def _poses(sim: SimModel, qpos: np.ndarray) -> list[Pose]:
    """pose_world_tip at each of `[T, Q]` coordinates."""
    import mujoco

    data, found = mujoco.MjData(sim.mj_model), []
    for data.qpos[:] in qpos:
        mujoco.mj_kinematics(sim.mj_model, data)
        tcp = data.site(TCP)
        found.append(Pose(tcp.xmat.reshape(3, 3).copy(), tcp.xpos.copy()))
    return found


def _title(runs: Sequence[results.Run]) -> str:
    if len(runs) == 1:
        return f"{runs[0].label}, from {results.observed(runs)}"
    return f"policies that see the {results.observed(runs)}"


def _frame(pegs: np.ndarray, runs: Sequence[results.Run]) -> tuple[tuple[float, float], ...]:
    """Limits that hold the boards, trocars and what paths do near them, the same in all panels."""
    low, high = pegs.min(0) - 1.3 * _MARGIN, pegs.max(0) + 1.3 * _MARGIN
    corners = np.array([[x, y, 0.0] for x in (low[0], high[0]) for y in (low[1], high[1])])
    rollouts = [rollout for run in runs for rollout in run.rollouts]
    above = [rollout.p_world_trocar[None] + [0.0, 0.0, _BEYOND + 2e-3] for rollout in rollouts]
    fixed = _flat(np.concatenate([corners, *above]))
    paths = _flat(np.concatenate([rollout.p_world_tip for rollout in rollouts]))
    low = np.minimum(fixed.min(0), np.maximum(paths.min(0), fixed.min(0) - _ROOM))
    high = np.maximum(fixed.max(0), np.minimum(paths.max(0), fixed.max(0) + _ROOM))
    return tuple((float(a), float(b)) for a, b in zip(low, high))


def _scale_bar(axis: Any, frame: tuple[tuple[float, float], ...], shades: dict[str, str]) -> None:
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
    colors = [line(style.method(run.result["method"])[0], run.label) for run in runs]
    lost = line(shades["muted"], "failure", linestyle="--", marker="s", markersize=4)
    return [*colors, lost, cross]


def _flat(points: np.ndarray) -> np.ndarray:
    """World points `[..., 3]` m to the drawing's plane `[..., 2]` m."""
    return np.asarray(points) @ _VIEW
