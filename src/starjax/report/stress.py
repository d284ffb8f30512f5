"""Table and figure of a stress.json: success and RCM error under each disturbance."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from starjax.report import formats, stats, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NOTE = (
    "Each row is one disturbance alone, on the trials of the undisturbed policy. Success with its "
    "95% Wilson interval; a loss is significant if Newcombe's 95% interval of the difference from "
    "the undisturbed policy is above zero. Executed RCM error at the true trocar; force of a "
    "spring of 1 N/mm with a damper at the trocar."
)
# Failures announced before the clock's alarm, and false alarms.
_ALARMS = {"Alarms on failures": "before_clock", "On successes": "false_alarms"}
_MIN_MM = 1e-2  # RCM error at the centre of its circle
# Undisturbed to strongest.
_SHADES = ("#2083C5", "#009E73", "#E69F00", "#D55E00", "#7A1F5C")

Content = Mapping[str, Any]  # for a stress.json


class StressRow(NamedTuple):
    """A level of a disturbance.

    Attributes:
      name: the disturbance, or `together`.
      effect: its description.
      level: with its unit.
      is_undisturbed: the level is zero.
      success: strict.
      measured: name -> text of RCM errors and of the force on the abdominal wall.
      alarms: name -> text of a monitor's alarms, empty without a monitor.
    """

    name: str
    effect: str
    level: str
    is_undisturbed: bool
    success: stats.Rate
    measured: dict[str, str]
    alarms: dict[str, str]


def scores(content: Content) -> list[StressRow]:
    """Returns all levels of all disturbances in their order, then those at once."""
    found = [
        _score(name, kind.get("what", ""), f"{level} {kind['unit']}".strip(), score)
        for name, kind in content["disturbances"].items()
        for level, score in kind["levels"].items()
    ]
    if together := content.get("together"):
        at_once = ", ".join(f"{name} {level:g}" for name, level in together["levels"].items())
        found.append(_score("together", "", at_once, together))
    return found


def table(content: Content) -> formats.Table:
    """Makes a row per level of each disturbance."""
    found = scores(content)
    alarms = next((score.alarms for score in found if score.alarms), {})
    rows = [["Disturbance", "Level", "Success (%)", *found[0].measured, *alarms]]
    for score in found:
        cells = [*score.measured.values(), *score.alarms.values()]
        rows.append([score.name, score.level, formats.rate(score.success), *cells])
    return rows


def markdown(content: Content) -> str:
    """Renders the table with a heading."""
    title = f"Success of {content['method']} under disturbances"
    return f"# {title}\n\n{formats.render(table(content), 2)}\n\n{NOTE}\n"


def draw(content: Content, dark: bool = False) -> Any:
    """Draws success and RCM error of every disturbance from its lowest to its highest level."""
    kinds = content["disturbances"]
    angles = np.linspace(0.0, 2.0 * np.pi, len(kinds), endpoint=False)
    names = [f"{name}\n{_span(kind)}" for name, kind in kinds.items()]
    count = max(len(kind["levels"]) for kind in kinds.values())
    is_undisturbed = all(float(next(iter(kind["levels"]))) == 0 for kind in kinds.values())
    with style.use(dark):
        figure = style.figure(9.4, 5.0)
        success, error = figure.subplots(1, 2, subplot_kw={"projection": "polar"})
        for rank in range(count):
            scores = [_at(kind["levels"], rank) for kind in kinds.values()]
            line = {
                "color": _SHADES[round(rank / max(count - 1, 1) * (len(_SHADES) - 1))],
                "linewidth": 1.4,
            }
            line |= {"marker": "o", "markersize": 3, "label": _label(rank, count, is_undisturbed)}
            _around(success, angles, [score["strict"]["rate"] for score in scores], line)
            _around(error, angles, [_logarithm(score) for score in scores], line)
        success.set_title("Success", pad=14, loc="center")
        success.set_ylim(0, 1)
        success.set_yticks([0.25, 0.5, 0.75, 1], ["25", "50", "75", "100%"])
        error.set_title("RCM error, 99th percentile", pad=14, loc="center")
        error.set_ylim(0, 3)
        error.set_yticks([0, 1, 2, 3], ["0.01", "0.1", "1", "10 mm"])
        for axis in (success, error):
            axis.set_theta_zero_location("N")
            axis.set_theta_direction(-1)
            axis.set_xticks(angles, names, fontsize=6)
            for label, angle in zip(axis.get_xticklabels(), angles):
                side = round(float(np.sin(angle)), 6)
                label.set_ha("left" if side > 0 else "right" if side else "center")
            axis.tick_params(axis="x", pad=3)
            axis.tick_params(axis="y", labelsize=6)
            axis.set_rlabel_position(np.rad2deg(angles[1]) / 2 if len(kinds) > 1 else 90)
        style.legend(figure, *success.get_legend_handles_labels(), max_columns=count)
    return figure


def _score(name: str, effect: str, level: str, score: Content) -> StressRow:
    error, wall = score["rcm_error_mm"]["executed"], score.get("wall_force_N") or {}
    figures = {
        "RCM mean (mm)": error["mean"],
        "RCM p99 (mm)": error["p99"],
        "Wall p99 (N)": wall.get("p99"),
    }
    alarms = score.get("alarms") or {}
    return StressRow(
        name,
        effect,
        level,
        is_undisturbed=level.split()[0] == "0",
        success=stats.rate(score["strict"]["successes"], score["strict"]["trials"]),
        measured={k: "\u2013" if v is None else f"{v:.2f}" for k, v in figures.items()},
        alarms={
            title: f"{alarms[key]['successes']}/{alarms[key]['trials']}"
            for title, key in _ALARMS.items()
            if alarms
        },
    )


def _span(kind: Content) -> str:
    levels = [level for level in kind["levels"] if float(level)]
    ends = dict.fromkeys([levels[0], levels[-1]]) if levels else {}
    return f"{' to '.join(ends)} {kind['unit']}".strip()


def _at(levels: Mapping[str, Any], rank: int) -> Any:
    """Returns the score of the level of this rank, or of the highest level."""
    return list(levels.values())[min(rank, len(levels) - 1)]


def _label(rank: int, count: int, is_undisturbed: bool) -> str:
    if rank == 0:
        return "undisturbed" if is_undisturbed else "lowest level"
    return "highest level" if rank == count - 1 else f"level {rank if is_undisturbed else rank + 1}"


def _logarithm(score: Content) -> float:
    error = score["rcm_error_mm"]["executed"]["p99"]
    return float(np.clip(np.log10(max(error or 0.0, _MIN_MM) / _MIN_MM), 0.0, 3.0))


def _around(axis: "Axes", angles: np.ndarray, values: list[float], line: dict[str, Any]) -> None:
    closed = [*range(len(angles)), 0]
    axis.plot(angles[closed], np.array(values)[closed], **line)
