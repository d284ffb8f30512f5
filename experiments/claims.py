"""One claim: a folder with claim.toml, results and figures, drawn as its README.

claim.toml holds the text that cannot be drawn from results:

    title, claim, date    the finding in words, and its date
    code                  the code's version, if the results do not name a commit
    commands              the commands that made the results
    rows_are              header of the first column, default "Method"
    notes                 remarks, one list item each
    [runs]                name in the tables -> result file in this folder or another claim's
    [[tables]]            name, title, columns (of `columns.COLUMNS`), rows (default all)
    [[pairs]]             name, title, rows [[a, b], ...], part (of `columns.PARTS`)
    [[figures]]           file, text
"""

import functools
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import columns

from starjax.report import formats

HERE = Path(__file__).parent


class Claim(NamedTuple):
    """A claim with its results.

    Attributes:
      name: name of its folder.
      spec: content of claim.toml.
      runs: name in the tables -> result with its sweep and held-out errors.
    """

    name: str
    spec: dict[str, Any]
    runs: dict[str, columns.Scored]


@functools.cache
def load(folder: Path) -> Claim:
    """Reads a claim's folder."""
    spec = tomllib.loads((folder / "claim.toml").read_text())
    runs = {name: columns.read(folder / file, name) for name, file in spec["runs"].items()}
    return Claim(folder.name, spec, runs)


def folders() -> list[Path]:
    """Returns the folders of all claims, the newest first."""
    claimed = [file.parent for file in HERE.glob("*/claim.toml")]
    return sorted(claimed, key=lambda x: (_date(x), x.name), reverse=True)


def table(claim: Claim, name: str, rows: Sequence[str] | None = None) -> str:
    """Returns a table of the claim as markdown.

    Args:
      claim: the claim.
      name: name of one of its tables or pairs.
      rows: names of the runs to show, None for those of claim.toml.

    Raises:
      KeyError: the claim has no table of that name.
    """
    for spec in claim.spec.get("tables", []):
        if spec["name"] == name:
            runs = [claim.runs[row] for row in rows or spec.get("rows", claim.runs)]
            header = [_rows_are(claim), *(columns.COLUMNS[column][0] for column in spec["columns"])]
            draws = [columns.COLUMNS[column][1] for column in spec["columns"]]
            body = [[run.run.label, *(draw(run) for draw in draws)] for run in runs]
            return formats.render([header, *body], names=1)
    for spec in claim.spec.get("pairs", []):
        if spec["name"] == name:
            pairs = [[claim.runs[run] for run in row] for row in spec["rows"]]
            drawn = columns.paired(pairs, spec.get("part", "twelve"))
            return formats.render([[_rows_are(claim), *drawn[0][1:]], *drawn[1:]], names=2)
    raise KeyError(f"{claim.name}: no table {name}")


def readme(claim: Claim) -> str:
    """Returns the page of a claim."""
    spec = claim.spec
    parts = [f"# {spec['title']}", spec["claim"], provenance(claim)]
    for drawn in [*spec.get("tables", []), *spec.get("pairs", [])]:
        parts += [f"## {drawn['title']}", table(claim, drawn["name"])]
    parts += [f"![{figure['text']}]({figure['file']})" for figure in spec.get("figures", [])]
    if spec.get("notes"):
        parts += ["## Notes", "\n".join(f"- {note}" for note in spec["notes"])]
    parts += ["## Commands", f"```bash\n{spec['commands'].strip()}\n```"]
    return "\n\n".join(parts) + "\n"


def provenance(claim: Claim) -> str:
    """Returns date, commits, machines and versions of jax of the results."""
    results = [run.run.result for run in claim.runs.values()]
    commits = [formats.code(result.commit, result.dirty) for result in results]
    code = ", ".join(dict.fromkeys(filter(None, commits)))
    code = code or claim.spec.get("code", "before results recorded their commits")
    machines = dict.fromkeys(formats.machine(result.about["hardware"]) for result in results)
    jax = dict.fromkeys(result.about["versions"]["jax"] for result in results)
    return (
        f"{claim.spec['date']}; code: {code}; {'; '.join(machines)}; jax {', '.join(jax)}. "
        "How to read the tables: [experiments](../README.md)."
    )


def index(claims: list[Claim]) -> str:
    """Returns a table of all claims."""
    rows = [
        [f"[{claim.spec['title']}]({claim.name}/README.md)", claim.spec["claim"].strip()]
        for claim in claims
    ]
    return formats.render([["Claim", "Finding"], *rows], 2)


def _rows_are(claim: Claim) -> str:
    return claim.spec.get("rows_are", "Method")


def _date(folder: Path) -> str:
    return str(tomllib.loads((folder / "claim.toml").read_text())["date"])
