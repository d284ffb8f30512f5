"""One self-contained HTML page of a report, from the templates in `templates/`.

The page links to no other file. Its only script is that of the rollouts in 3D, a page in a frame.
"""

import base64
import statistics
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jinja2

from starjax.report import (
    captions,
    compare,
    formats,
    notes,
    outcomes,
    results,
    sections,
    stats,
    stress,
    tables,
)

# name -> (light PNG, dark PNG)
Figures = Mapping[str, tuple[bytes, bytes]]


class Playback(NamedTuple):
    """A page with rollouts in 3D.

    Attributes:
      html: the page.
      caption: names of the rollouts.
    """

    html: str
    caption: str


class PageLead(NamedTuple):
    """Another beginning of a page.

    Attributes:
      template: extends page.html.
      values: names in the template -> values.
    """

    template: str
    values: Mapping[str, Any]


def render(
    runs: Sequence[results.Run],
    focus: results.Run,
    figures: Figures,
    video: bytes | None,
    playback: Playback | None = None,
    against: str = "",
    lead: PageLead | None = None,
) -> str:
    """Renders the page of `runs`, whose headline numbers are those of `focus`.

    `against` is that of `tables.paired`.
    """
    template, values = lead or PageLead("page.html", {})
    return (
        environment()
        .get_template(template)
        .render(
            runs=runs,
            focus=focus,
            several=len(runs) > 1,
            text=compare.task_text(runs),
            figures=figures,
            video=video,
            playback=playback,
            against=against,
            **values,
        )
    )


def environment() -> jinja2.Environment:
    """Returns the templates' environment."""
    made = jinja2.Environment(
        loader=jinja2.PackageLoader("starjax.report"),
        autoescape=True,  # labels, commands and settings come from files
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    filters = {"data_uri": _data_uri, "median": statistics.median}
    made.filters |= {**filters, "worst_rcm_mm": outcomes.worst_rcm_mm}
    modules = (
        captions,
        compare,
        formats,
        notes,
        outcomes,
        results,
        sections,
        stats,
        stress,
        tables,
    )
    made.globals |= {module.__name__.split(".")[-1]: module for module in modules}
    return made


def _data_uri(data: bytes, kind: str) -> str:
    """Embeds a file in the page."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
