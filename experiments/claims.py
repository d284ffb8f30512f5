"""One claim: a folder with claim.toml, results and figures, drawn as its README.

claim.toml holds what cannot be drawn from results:

    title, claim, date    what was found, in words without figures, and when
    code                  what is known of the code, where results do not name a commit
    commands              that made the results
    rows_are              what a row of the tables is, "Method" where left out
    notes                 what a reader must know, one a line
    [runs]                name in the tables -> result file in this folder or another claim's
    [[tables]]            name, title, columns (of `columns.COLUMNS`), rows (all where left out)
    [[pairs]]             name, title, rows [[a, b], ...], part (of `columns.PARTS`)
    [[figures]]           file, text
"""

import functools
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import columns

from starjax.report import formats

HERE = Path(__file__).parent


class Claim(NamedTuple):
    """A claim with its results.

    Attributes:
      name: of its folder.
      said: claim.toml.
      runs: name in the tables -> result, with what lies beside it.
    """

    name: str
    said: dict[str, Any]
    runs: dict[str, columns.Scored]


@functools.cache
def load(folder: Path) -> Claim:
    """Reads a claim's folder."""
    said = tomllib.loads((folder / "claim.toml").read_text())
    runs = {name: columns.read(folder / file, name) for name, file in said["runs"].items()}
    return Claim(folder.name, said, runs)


def folders() -> list[Path]:
    """All claims' folders, the newest first."""
    found = [file.parent for file in HERE.glob("*/claim.toml")]
    return sorted(found, key=lambda x: (_date(x), x.name), reverse=True)


def table(claim: Claim, name: str) -> str:
    """A table of the claim as markdown; KeyError where there is none of that name."""
    for said in claim.said.get("tables", []):
        if said["name"] == name:
            rows = [claim.runs[row] for row in said.get("rows", claim.runs)]
            header = [_rows_are(claim), *(columns.COLUMNS[column][0] for column in said["columns"])]
            draws = [columns.COLUMNS[column][1] for column in said["columns"]]
            body = [[run.run.label, *(draw(run) for draw in draws)] for run in rows]
            return formats.render([header, *body], names=1)
    for said in claim.said.get("pairs", []):
        if said["name"] == name:
            pairs = [[claim.runs[one] for one in row] for row in said["rows"]]
            drawn = columns.paired(pairs, said.get("part", "twelve"))
            return formats.render([[_rows_are(claim), *drawn[0][1:]], *drawn[1:]], names=2)
    raise KeyError(f"{claim.name}: no table {name}")


def readme(claim: Claim) -> str:
    """The page of a claim."""
    said = claim.said
    parts = [f"# {said['title']}", said["claim"], provenance(claim)]
    for drawn in [*said.get("tables", []), *said.get("pairs", [])]:
        parts += [f"## {drawn['title']}", table(claim, drawn["name"])]
    parts += [f"![{figure['text']}]({figure['file']})" for figure in said.get("figures", [])]
    if said.get("notes"):
        parts += ["## Notes", "\n".join(f"- {note}" for note in said["notes"])]
    parts += ["## Commands", f"```bash\n{said['commands'].strip()}\n```"]
    return "\n\n".join(parts) + "\n"


def provenance(claim: Claim) -> str:
    """Where the results are from: commits, date, machines, versions of jax."""
    found = [run.run.result for run in claim.runs.values()]
    commits = [formats.code(result.commit, result.dirty) for result in found]
    code = ", ".join(dict.fromkeys(filter(None, commits)))
    code = code or claim.said.get("code", "before results recorded their commits")
    machines = dict.fromkeys(formats.machine(result.about["hardware"]) for result in found)
    jax = dict.fromkeys(result.about["versions"]["jax"] for result in found)
    return (
        f"{claim.said['date']}; code: {code}; {'; '.join(machines)}; jax {', '.join(jax)}. "
        "How to read the tables: [experiments](../README.md)."
    )


def index(claims: list[Claim]) -> str:
    """A list of all claims."""
    rows = [
        [f"[{claim.said['title']}]({claim.name}/README.md)", claim.said["claim"].strip()]
        for claim in claims
    ]
    return formats.render([["Claim", "What was found"], *rows], 2)


def _rows_are(claim: Claim) -> str:
    return claim.said.get("rows_are", "Method")


def _date(folder: Path) -> str:
    return str(tomllib.loads((folder / "claim.toml").read_text())["date"])
