"""Draws the pictures of pages of results from their tables: rates with 95% intervals.

    python experiments/pictures.py            draws those that are missing or stale
    python experiments/pictures.py NAME ...   draws those of some pages

A page's `picture` names a table (`of`), files of stresses (`levels`, with `labels`), or runs
(`curves`, over the numbers `at` of the axis `x`). The digest of the drawn numbers stands in the
picture's file; a test compares it with the results.
"""

import hashlib
import io
import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import claims
import tables
from PIL import Image, PngImagePlugin

from starjax.report import stats, style

RESULTS = Path(__file__).resolve().parents[1] / "benchmarks" / "results"
COLUMNS = {
    "seen": "s",
    "unseen": "o",
    "other trocars": "D",
    "Its trocars": "s",
    "Others, drawn": "o",
}
COLOURS = ("#2083C5", "#D55E00", "#009E73")
DIGEST = "Numbers"  # key in the picture's file
_COUNTS = re.compile(r"([\d,]+)(?:/| of )([\d,]+)")
Scores = dict[str, dict[str, stats.Rate]]  # row or panel -> series -> rate


def rates(markdown: str) -> Scores:
    """Returns the rates of a table: row -> column -> rate, of `COLUMNS`."""
    lines = [re.split(r"(?<!\\)\|", line)[1:-1] for line in markdown.splitlines()]
    header, _, *body = ([cell.strip() for cell in line] for line in lines if line)
    scores: Scores = {}
    for name, *cells in body:
        found = zip(header[1:], map(_COUNTS.match, cells), strict=True)
        scores[name.replace("`", "")] = {
            column: stats.rate(*(int(x.replace(",", "")) for x in match.groups()))
            for column, match in found
            if match and column in COLUMNS
        }
    return scores


def levels(files: Sequence[str], labels: Sequence[str]) -> Scores:
    """Returns success by disturbance: name -> "LABEL LEVEL" -> rate."""
    scores: Scores = {}
    for file, label in zip(files, labels, strict=True):
        found = json.loads((RESULTS / f"{file}.json").read_text())["disturbances"]
        for name, one in found.items():
            row = scores.setdefault(name, {})
            for level, result in one["levels"].items():
                counts = result["strict"]["successes"], result["strict"]["trials"]
                row[f"{label} {level}"] = stats.rate(*counts)
    return scores


def curves(page: claims.Study) -> Scores:
    """Returns success of runs in one panel: "" -> "LABEL NUMBER" -> rate."""
    picture, row = page.spec["picture"], {}
    for label, runs in picture["curves"].items():
        for x, run in zip(picture["at"], runs, strict=True):
            result = json.loads((page.folder / page.spec["runs"][run]).read_text())["strict"]["all"]
            row[f"{label} {x}"] = stats.rate(result["successes"], result["trials"])
    return {"": row}


def scores_of(page: claims.Study) -> Scores:
    """Returns the numbers of a page's picture, none for a picture from elsewhere."""
    picture = page.spec["picture"]
    if "curves" in picture:
        return curves(page)
    if "levels" in picture:
        return levels(picture["levels"], picture["labels"])
    if "bar" in picture:
        return rates(tables.table(picture["bar"]))
    if "of" not in picture:
        return {}
    folder, name = (page.folder / picture["of"]).parent, Path(picture["of"]).name
    study = claims.load(folder)
    return rates(claims.table(study, name, study.spec.get("shown")))


def digest(scores: Scores) -> str:
    """Returns a digest of the drawn numbers."""
    plain = {row: {k: [x.successes, x.trials] for k, x in v.items()} for row, v in scores.items()}
    return hashlib.sha256(json.dumps(plain).encode()).hexdigest()[:16]


def digest_of(file: Path) -> str:
    """Returns the digest in a picture's file, empty without a file."""
    if not file.exists():
        return ""
    with Image.open(file) as image:
        return image.info.get(DIGEST, "")


def draw(page: claims.Study) -> bytes:
    """Returns the picture of a page as a png file."""
    scores, picture = scores_of(page), page.spec["picture"]
    with style.use() as shades:
        if "levels" in picture:
            figure = _panels(scores, picture["labels"])
        elif "curves" in picture:
            figure = _panels(scores, list(picture["curves"]), across=1, size=(5.0, 2.6))
            figure.axes[0].set_xlabel(picture["x"])
            figure.axes[0].set_ylabel("success")
        else:
            figure = _intervals(scores, shades["muted"])
    image = Image.open(io.BytesIO(style.save(figure, "png"))).convert(
        "P", palette=Image.Palette.ADAPTIVE
    )
    info, stream = PngImagePlugin.PngInfo(), io.BytesIO()
    info.add_text(DIGEST, digest(scores))
    image.save(stream, "png", pnginfo=info, optimize=True)
    return stream.getvalue()


def _intervals(scores: Scores, muted: str) -> Any:
    """Draws a line per row, a mark with its interval per column."""
    series = [name for name in COLUMNS if any(name in row for row in scores.values())]
    figure = style.figure(7.0, 0.9 + 0.25 * len(scores))
    axis = figure.subplots()
    for k, name in enumerate(series):
        shift = 0.2 * (k - (len(series) - 1) / 2)
        for y, row in enumerate(scores.values()):
            if name not in row:
                continue
            score, first = row[name], y == _first(scores, name)
            ends = [[score.rate - score.low], [score.high - score.rate]]
            axis.errorbar(
                score.rate, y + shift, xerr=ends, fmt=COLUMNS[name], color=COLOURS[k],
                markersize=3.5, linewidth=1.0, label=name.lower() if first else None,
            )  # fmt: skip
    axis.set_yticks(range(len(scores)), list(scores))
    axis.set_ylim(len(scores) - 0.4, -0.6)
    low = min(score.low for row in scores.values() for score in row.values())
    axis.set_xlim(max(0.0, low - 0.03), 1.01)
    axis.axvline(0.95, color=muted, linewidth=0.8, linestyle=":")
    axis.locator_params(axis="x", steps=[1, 2, 5, 10])
    axis.xaxis.set_major_formatter(lambda x, _: f"{100 * x:.0f}%")
    axis.set_xlabel("success, 95% interval; dotted: 95%")
    style.legend(figure, *axis.get_legend_handles_labels())
    return figure


def _panels(
    scores: Scores,
    labels: Sequence[str],
    across: int = 5,
    size: tuple[float, float] = (9.0, 1.45),
) -> Any:
    """Draws a panel per row: success against level, a line per label.

    `size` is the figure's width, and the height of a row of panels, in inches.
    """
    down = -(-len(scores) // across)
    figure = style.figure(size[0], 0.5 + size[1] * down)
    axes = figure.subplots(down, across, sharey=True, squeeze=False).flat
    for axis, (name, row) in zip(axes, scores.items(), strict=False):
        for label, colour, mark in zip(labels, COLOURS, "so", strict=False):
            points = [(k, x) for k, x in row.items() if k.startswith(f"{label} ")]
            x = [float(key.rpartition(" ")[2]) for key, _ in points]
            y = [score.rate for _, score in points]
            ends = [[s.rate - s.low for _, s in points], [s.high - s.rate for _, s in points]]
            axis.errorbar(
                x, y, ends, fmt=f"{mark}-", color=colour, markersize=3, linewidth=1.0, label=label
            )
        axis.set_title(name.replace("_", " "), fontsize=8)
        style.percent_axis(axis)
        axis.tick_params(labelsize=7)
    for axis in figure.axes[len(scores) :]:
        axis.set_visible(False)
    named = {}
    for axis in figure.axes:
        named |= dict(zip(*axis.get_legend_handles_labels()[::-1], strict=True))
    style.legend(figure, list(named.values()), list(named))
    return figure


def _first(scores: Scores, name: str) -> int:
    return next(y for y, row in enumerate(scores.values()) if name in row)


def main(names: Sequence[str]) -> None:
    for folder in claims.pages():
        page = claims.load(folder)
        scores, file = scores_of(page), folder / claims.PICTURE
        if scores and (folder.name in names or digest_of(file) != digest(scores)):
            file.write_bytes(draw(page))
            print(file.relative_to(claims.HERE))


if __name__ == "__main__":
    main(sys.argv[1:])
