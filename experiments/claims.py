"""Pages of results: a folder each, with claim.toml, results and pictures, drawn as its README.md.

A page has one study, or several in folders of their own (`studies`). claim.toml has of a page:

    title, question, answer  the subject, and at most 40 words of answer
    picture                  {file, text}, or one that `pictures.py` draws: {of, text} of a table,
                             {x, at, curves, text} of runs
    film                     an mp4 file
    studies                  folders of its studies, if there are several
    short                    true to leave conditions and commands of the studies to tables.md

and of a study:

    title, answer            with several studies
    date, code               its date, and the code's version if the results name no commit
    commands                 the commands that made the results
    rows_are                 header of the first column, default "Method"
    shown                    rows of the first table that the page shows, default all
    notes                    conditions, one list item each
    [runs]                   name in the tables -> result file
    [[tables]]               title, text, and either name, columns (of `columns.COLUMNS`) and rows
                             (default all), or draw: a table of `tables.py`; all but the first
                             stand in tables.md
    [[pairs]]                name, title, rows [[a, b], ...], part (of `columns.PARTS`)
    [[figures]]              file, text

`{RUN|COLUMN}` in an answer is the count of a run, such as 784 of 800; `{RUN|COLUMN%}` its
percentage. In a page with studies a run is STUDY:RUN.
"""

import functools
import os
import re
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import columns

from starjax.report import formats

HERE = Path(__file__).parent
PICTURE = "success.png"  # drawn by pictures.py
TABLES = "tables.md"
DETAILS = ("gap", "tip", "roll", "seeds", "code", "loose", "rcm_won")  # columns of tables.md alone
# Pages by group, in the order of the paper.
GROUPS = {
    "The paper": ("methods", "training_trocars", "main_job", "packaged_policies"),
    "Tasks": ("tasks", "experts", "trocar_benchmark"),
    "Robustness": ("disturbances", "monitor"),
    "Wrists and needles": ("wrist", "needle_drive"),
    "Learning": ("pauses", "learners", "fine_tuning", "ablations"),
}
_VALUE = re.compile(r"\{((?:\{T\}|[^{}|])+)\|(\w+)(%?)\}")


class Study(NamedTuple):
    """A study, or a page of studies.

    Attributes:
      folder: its folder.
      spec: content of claim.toml.
      runs: name in the tables -> result with its sweep and held-out errors.
    """

    folder: Path
    spec: dict[str, Any]
    runs: dict[str, columns.Scored]


@functools.cache
def load(folder: Path) -> Study:
    """Reads a folder; the runs of a page with studies are those of its studies."""
    spec = tomllib.loads((folder / "claim.toml").read_text())
    files = spec.get("runs", {})
    runs = {name: columns.read(folder / file, name) for name, file in files.items()}
    for name in spec.get("studies", []):
        found = load(folder / name).runs
        runs |= {f"{name}:{run}": scored for run, scored in found.items()}
    return Study(folder, spec, runs)


def pages() -> list[Path]:
    """Returns the folders of all pages, in order."""
    return [HERE / name for names in GROUPS.values() for name in names]


def folders() -> list[Path]:
    """Returns the folders of all studies and pages."""
    return [
        folder / name for folder in pages() for name in ("", *load(folder).spec.get("studies", []))
    ]


def table(
    study: Study, name: str, rows: Sequence[str] | None = None, without: Sequence[str] = ()
) -> str:
    """Returns a table of the study as markdown.

    Args:
      study: the study.
      name: name of one of its tables or pairs.
      rows: names of the runs to show, None for those of claim.toml.
      without: columns that are omitted.

    Raises:
      KeyError: the study has no table of that name.
    """
    for spec in study.spec.get("tables", []):
        if spec.get("name") == name:
            runs = [study.runs[row] for row in rows or spec.get("rows", study.runs)]
            drawn = [columns.COLUMNS[name] for name in spec["columns"] if name not in without]
            header = [_rows_are(study), *(head for head, _ in drawn)]
            draws = [draw for _, draw in drawn]
            body = [[run.run.label, *(draw(run) for draw in draws)] for run in runs]
            return formats.render([header, *body], names=1)
    for spec in study.spec.get("pairs", []):
        if spec["name"] == name:
            pairs = [[study.runs[run] for run in row] for row in spec["rows"]]
            drawn = columns.paired(pairs, spec.get("part", "twelve"))
            return formats.render([[_rows_are(study), *drawn[0][1:]], *drawn[1:]], names=2)
    raise KeyError(f"{study.folder}: no table {name}")


def readme(page: Study, draw: Callable[[str], str]) -> str:
    """Returns the text of a page; `draw` returns the table of a name of `tables.py`."""
    spec, studies = page.spec, _studies(page)
    parts = [f"# {spec['title']}", f"*{spec['question']}*", filled(page, spec["answer"])]
    picture = spec["picture"]
    parts.append(f"![{picture['text']}]({picture.get('file', PICTURE)})")
    if "film" in spec:
        parts.append(f"[Film of the picture above]({spec['film']})")
    for study in studies:
        if study is not page:
            parts += [f"## {study.spec['title']}", filled(study, study.spec["answer"])]
        parts += _study(page, study, draw)
    if further(page, draw):
        name = f"experiments/{page.folder.name}/{TABLES}"
        what = "Commands, conditions" if spec.get("short") else "Paired tests"
        parts.append(f"{what} and further tables: [`{name}`]({TABLES}).")
    return "\n\n".join(parts) + "\n"


def further(page: Study, draw: Callable[[str], str]) -> str:
    """Returns whole tables and further figures of a page, nothing if its text has them all."""
    parts = []
    for study in _studies(page):
        drawn = [_drawn(study, spec, draw) for spec in _tables(study)[0 if _is_cut(study) else 1 :]]
        drawn += [_figure(page, study, one) for one in _figures(page, study)[1:]]
        drawn += _origin(study) if page.spec.get("short") else []
        parts += [f"## {study.spec['title']}", *drawn] if drawn else []
    title = f"# Further tables: {page.spec['title']}"
    return "\n\n".join([title, "[The page](README.md).", *parts]) + "\n" if parts else ""


def filled(study: Study, text: str) -> str:
    """Returns a text with the counts and percentages of runs in place of `{RUN|COLUMN}`.

    Raises:
      KeyError: the study has no such run, or there is no such column.
    """

    def value(match: re.Match[str]) -> str:
        cell = columns.COLUMNS[match[2]][1](study.runs[match[1]])
        count, _, percent = cell.partition(": ")
        return percent.split()[0] if match[3] else count.replace("/", " of ")

    return _VALUE.sub(value, text)


def provenance(study: Study) -> str:
    """Returns date, commits, machines and versions of jax of the results."""
    results = [run.run.result for run in study.runs.values()]
    if not results:
        return f"{study.spec['date']}; each result in `benchmarks/results` names its commit."
    commits = [formats.code(result.commit, result.dirty) for result in results]
    code = ", ".join(dict.fromkeys(filter(None, commits)))
    code = code or study.spec.get("code", "before results recorded their commits")
    machines = dict.fromkeys(formats.machine(result.about["hardware"]) for result in results)
    jax = dict.fromkeys(result.about["versions"]["jax"] for result in results)
    return f"{study.spec['date']}; code: {code}; {'; '.join(machines)}; jax {', '.join(jax)}."


def index() -> str:
    """Returns a table per group of pages: title and answer."""
    parts = []
    for group, names in GROUPS.items():
        rows = [["Page", "Answer"]]
        for name in names:
            page = load(HERE / name)
            link = f"[{page.spec['title']}]({name}/README.md)"
            rows.append([link, filled(page, page.spec["answer"])])
        parts += [f"### {group}", formats.render(rows, 2)]
    return "\n\n".join(parts)


def _studies(page: Study) -> list[Study]:
    """Returns the studies of a page, which is one itself if it has no others."""
    return [load(page.folder / name) for name in page.spec.get("studies", [])] or [page]


def _tables(study: Study) -> list[dict[str, Any]]:
    return [*study.spec.get("tables", []), *study.spec.get("pairs", [])]


def _figures(page: Study, study: Study) -> list[dict[str, Any]]:
    """Returns the figures of a study without the page's picture."""
    picture = page.folder / page.spec["picture"].get("file", PICTURE)
    figures = study.spec.get("figures", [])
    return [one for one in figures if (study.folder / one["file"]).resolve() != picture.resolve()]


def _figure(page: Study, study: Study, figure: dict[str, Any]) -> str:
    return f"![{figure['text']}]({os.path.relpath(study.folder / figure['file'], page.folder)})"


def _is_cut(study: Study) -> bool:
    """Returns True if the page shows a part of the first table."""
    first = _tables(study)[0]
    return "shown" in study.spec or bool(set(DETAILS) & set(first.get("columns", [])))


def _drawn(study: Study, spec: dict[str, Any], draw: Callable[[str], str], text: str = "") -> str:
    """Returns a table, or `text` as its rows, with its title."""
    body = text or (draw(spec["draw"]) if "draw" in spec else table(study, spec["name"]))
    return f"**{spec['title']}.** {spec.get('text', '')}".strip() + f"\n\n{body}"


def _study(page: Study, study: Study, draw: Callable[[str], str]) -> list[str]:
    """Returns the first table, a figure and, on most pages, conditions, commands and provenance."""
    spec, first = study.spec, _tables(study)[0]
    short = table(study, first["name"], spec.get("shown"), DETAILS) if _is_cut(study) else ""
    parts = [_drawn(study, first, draw, short)]
    parts += [_figure(page, study, one) for one in _figures(page, study)[:1]]
    return parts if page.spec.get("short") else [*parts, *_origin(study)]


def _origin(study: Study) -> list[str]:
    """Returns conditions, commands and provenance."""
    notes = ["\n".join(f"- {note}" for note in study.spec.get("notes", []))]
    commands = f"```bash\n{study.spec['commands'].strip()}\n```"
    return [*filter(None, notes), commands, provenance(study)]


def _rows_are(study: Study) -> str:
    return study.spec.get("rows_are", "Method")
