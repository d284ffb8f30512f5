"""Pages of results: a folder each, with claim.toml, results and pictures, drawn as its README.

A page has one study, or several in folders of their own (`studies`). claim.toml has of a page:

    title, question, answer  the subject, and at most 40 words of answer
    picture                  {file, text}, or {of, text} of a picture that `pictures.py` draws
    film                     an mp4 file
    studies                  folders of its studies, if there are several

and of a study:

    title, answer            with several studies
    date, code               its date, and the code's version if the results name no commit
    commands                 the commands that made the results
    rows_are                 header of the first column, default "Method"
    notes                    conditions, one list item each
    [runs]                   name in the tables -> result file
    [[tables]]               title, text, and either name, columns (of `columns.COLUMNS`) and rows
                             (default all), or draw: a table of `tables.py`; the first is in sight
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
# Pages by group, in the order of the paper.
GROUPS = {
    "The paper": ("methods", "training_trocars", "main_job", "packaged_policies"),
    "Tasks": ("tasks", "experts", "trocar_benchmark"),
    "Robustness": ("disturbances", "monitor", "served_robots"),
    "Wrists and needles": ("wrist", "needle_drive"),
    "Learning": ("learners", "fine_tuning", "ablations"),
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


def table(study: Study, name: str, rows: Sequence[str] | None = None) -> str:
    """Returns a table of the study as markdown.

    Args:
      study: the study.
      name: name of one of its tables or pairs.
      rows: names of the runs to show, None for those of claim.toml.

    Raises:
      KeyError: the study has no table of that name.
    """
    for spec in study.spec.get("tables", []):
        if spec.get("name") == name:
            runs = [study.runs[row] for row in rows or spec.get("rows", study.runs)]
            header = [_rows_are(study), *(columns.COLUMNS[column][0] for column in spec["columns"])]
            draws = [columns.COLUMNS[column][1] for column in spec["columns"]]
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
    spec, names = page.spec, page.spec.get("studies", [])
    parts = [f"# {spec['title']}", f"*{spec['question']}*", filled(page, spec["answer"])]
    picture = spec["picture"]
    parts.append(f"![{picture['text']}]({picture.get('file', PICTURE)})")
    if "film" in spec:
        parts.append(f"[Film of the picture above]({spec['film']})")
    for name in names:
        study = load(page.folder / name)
        parts += [f"## {study.spec['title']}", filled(study, study.spec["answer"])]
        parts += _study(study, page.folder, draw)
    if not names:
        parts += _study(page, page.folder, draw)
    return "\n\n".join(parts) + "\n"


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
    """Returns a table per group of pages: title, question and answer."""
    parts = []
    for group, names in GROUPS.items():
        rows = [["Page", "Question", "Answer"]]
        for name in names:
            page = load(HERE / name)
            link = f"[{page.spec['title']}]({name}/README.md)"
            rows.append([link, page.spec["question"], filled(page, page.spec["answer"])])
        parts += [f"### {group}", formats.render(rows, 3)]
    return "\n\n".join(parts)


def _study(study: Study, page: Path, draw: Callable[[str], str]) -> list[str]:
    """Returns tables, figures, notes, commands and origin; all tables but one are folded."""
    spec, drawn = study.spec, []
    for one in [*spec.get("tables", []), *spec.get("pairs", [])]:
        body = draw(one["draw"]) if "draw" in one else table(study, one["name"])
        head = f"**{one['title']}.** {one.get('text', '')}".strip()
        drawn.append((one["title"], f"{head}\n\n{body}"))
    parts = [text for _, text in drawn[:1]]
    for figure in spec.get("figures", []):
        file = os.path.relpath(study.folder / figure["file"], page)
        parts.append(f"![{figure['text']}]({file})")
    if spec.get("notes"):
        parts.append("\n".join(f"- {note}" for note in spec["notes"]))
    if drawn[1:]:
        titles = "; ".join(title.replace("`", "") for title, _ in drawn[1:])
        parts.append(f'<details markdown="1">\n<summary>Further tables: {titles}</summary>')
        parts += [text for _, text in drawn[1:]]
        parts.append("</details>")
    return [*parts, f"```bash\n{spec['commands'].strip()}\n```", provenance(study)]


def _rows_are(study: Study) -> str:
    return study.spec.get("rows_are", "Method")
