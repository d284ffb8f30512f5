"""HTML building blocks of the page: tables, interval bars, tinted cells, embedded files."""

import base64
import html
from collections.abc import Sequence
from typing import NamedTuple

from starjax.report import formats, stats


class Cell(NamedTuple):
    """One table cell: finished HTML, the class that sets it, and how many columns it heads."""

    html: str
    kind: str = ""
    style: str = ""
    span: int = 1


def escape(text: object) -> str:
    """Text as HTML."""
    return html.escape(str(text))


def number(text: str) -> Cell:
    """A cell set to the right."""
    return Cell(escape(text), "number")


def table(header: Sequence[Cell], rows: Sequence[Sequence[Cell]]) -> str:
    """A table that scrolls sideways where the screen is too narrow."""
    head = "".join(_th(cell) for cell in header)
    body = "".join(f"<tr>{''.join(_td(cell) for cell in row)}</tr>\n" for row in rows)
    top = f"<thead><tr>{head}</tr></thead>"
    return f'<div class="scroll"><table>{top}<tbody>\n{body}</tbody></table></div>'


def plain(rows: formats.Table, note: str) -> str:
    """A table of text with the note under it; numbers to the right."""
    names = formats.names_in(rows[0])
    cells = [[Cell(escape(t)) if i < names else number(t) for i, t in enumerate(r)] for r in rows]
    return table(cells[0], cells[1:]) + small(note)


def small(text: str) -> str:
    """A line of fine print."""
    return f'<p class="small">{escape(text)}</p>'


def score(rate: stats.Rate | None, part: str) -> list[Cell]:
    """Two cells: the interval as a bar coloured by `part` (seen or unseen), the counts."""
    if rate is None:
        return [Cell(""), number("–")]
    said = f"<b>{100 * rate.rate:.0f}%</b> {rate.successes}/{rate.trials}"
    return [Cell(interval(rate, part), "bar"), Cell(said, "number")]


def interval(rate: stats.Rate, part: str) -> str:
    """The rate as a tick in its interval on a track from 0 to 100%."""
    low, high, middle = (100 * x for x in (rate.low, rate.high, rate.rate))
    said = f"{middle:.1f}%, 95% interval {low:.1f} to {high:.1f}%"
    return (
        f'<span class="ci {part}" role="img" aria-label="{said}" title="{said}">'
        f'<i style="left:{low:.2f}%;width:{high - low:.2f}%"></i>'
        f'<b style="left:{middle:.2f}%"></b></span>'
    )


def tint(rate: stats.Rate, mark: str) -> Cell:
    """A cell shaded by its rate, which a mark follows."""
    most = 45  # percent of the colour: on light and dark paper the text stays readable (WCAG AA)
    shade = f"background:color-mix(in srgb, var(--seen) {round(most * rate.rate)}%, transparent)"
    return Cell(f"{100 * rate.rate:.0f}{mark}", "tint", shade)


def uri(kind: str, data: bytes) -> str:
    """A file inside the page."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def _th(cell: Cell) -> str:
    kind = f' class="{cell.kind}"' if cell.kind else ""
    span = f' colspan="{cell.span}" scope="colgroup"' if cell.span > 1 else ' scope="col"'
    return f"<th{kind}{span}>{cell.html}</th>"


def _td(cell: Cell) -> str:
    style = f' style="{cell.style}"' if cell.style else ""
    kind = f' class="{cell.kind}"' if cell.kind else ""
    return f"<td{kind}{style}>{cell.html}</td>"
