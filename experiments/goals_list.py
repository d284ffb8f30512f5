"""Goals against figures, row by row, as tables of goals/README.md.

goals/<section>.toml has the rows of a table `goals_list_<section>`:

  goal      its text
  wanted    text, e.g. "at least 95 / 90%"
  figures   list of [file, key, ...]: rates or numbers in results, from the repository's root
  least     their lower bounds (of rates in percent), or `most` their upper ones
  unit      of numbers
  measured  text in place of figures, or before them
  met       text in place of the comparison with bounds
  note      attempts, or the reason why a goal is missed or not measured
  test      file of a test that shows it

A row without figures and without a test is not measured.
"""

import json
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from starjax.evaluation import statistics
from starjax.report import formats

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
PREFIX = "goals_list_"
MISSING = "–"
HEADER = ["Goal", "Wanted", "Measured", "Met", "Result"]


def table(name: str) -> str:
    """Returns the table of a section.

    Raises:
      KeyError: a row names a key that its result does not have.
    """
    rows = [HEADER]
    for row in _rows(name.removeprefix(PREFIX)):
        found = [_figure(path) for path in row.get("figures", [])]
        text = "; ".join([*_listed(row, "measured"), *(_text(x, row) for x in found)])
        links = [_link(file) for file in files([row])] + [_link(x) for x in _listed(row, "test")]
        met = "; ".join([_met(row, found), *_listed(row, "note")])
        rows.append([row["goal"], row["wanted"], text or MISSING, met, ", ".join(links) or MISSING])
    return formats.render(rows, names=len(HEADER))


def files(rows: list[dict[str, Any]] | None = None) -> list[str]:
    """Returns the results of some rows, of all sections by default, each once."""
    if rows is None:
        rows = [row for section in sections() for row in _rows(section)]
    return list(dict.fromkeys(path[0] for row in rows for path in row.get("figures", [])))


def sections() -> list[str]:
    """Returns the names of all sections."""
    found = {path.stem: tomllib.loads(path.read_text()) for path in HERE.glob("goals/*.toml")}
    return sorted(name for name, content in found.items() if "rows" in content)


def origin(file: str) -> list[str]:
    """Returns a result's link, its commands, seed, commit and machine."""
    result = json.loads((ROOT / file).read_text())
    made = result.get("made") or {}
    parts = [result, made, *(part for part in made.values() if isinstance(part, dict))]
    commands = dict.fromkeys(command for part in parts for command in _commands(part))
    codes = dict.fromkeys(
        formats.code(part["commit"], part.get("dirty")) for part in parts if "commit" in part
    )
    text = "<br>".join(f"`{command}`" for command in commands)
    on = formats.machine(result["hardware"])
    seed = str(result.get("seed", MISSING if made else 0))
    return [_link(file), text, seed, ", ".join(codes), on]


def _rows(section: str) -> list[dict[str, Any]]:
    return tomllib.loads((HERE / "goals" / f"{section}.toml").read_text())["rows"]


def _commands(part: dict[str, Any]) -> Iterator[str]:
    yield from part.get("commands") or []
    if "command" in part:
        yield part["command"]


def _listed(row: dict[str, Any], name: str) -> list[str]:
    return [row[name]] if name in row else []


def _link(file: str) -> str:
    path = Path(file)
    assert (ROOT / path).exists(), file
    name = path.name if path.parent.name in ("results", "goals") else "/".join(path.parts[-2:])
    return f"[{name}](../../{file})"


def _figure(path: list[str]) -> Any:
    found: Any = json.loads((ROOT / path[0]).read_text())
    for key in path[1:]:
        found = found[int(key)] if isinstance(found, list) else found[key]
    return found


def _is_rate(found: Any) -> bool:
    return isinstance(found, dict)


def _value(found: Any) -> float:
    return 100 * found["rate"] if _is_rate(found) else found


def _text(found: Any, row: dict[str, Any]) -> str:
    if not _is_rate(found):
        return f"{found:.3g}{' ' if 'unit' in row else ''}{row.get('unit', '')}"
    trials = found.get("trials", found.get("episodes"))
    low, high = (100 * bound for bound in statistics.wilson(found["successes"], trials))
    count = f"{found['successes']:,}/{trials:,}"
    return f"{count}: {100 * found['rate']:.1f}% ({low:.1f}-{high:.1f})"


def _met(row: dict[str, Any], found: list[Any]) -> str:
    """Compares figures with bounds; one bound is that of all."""
    if "met" in row:
        return row["met"]
    if not found:
        return "yes" if "test" in row else "not measured"
    sign = 1 if "least" in row else -1
    bounds = row["least"] if "least" in row else row["most"]
    bounds = bounds * len(found) if len(bounds) == 1 else bounds
    missed = [sign * (bound - _value(x)) for bound, x in zip(bounds, found, strict=True)]
    left = [f"{by:.2g}" for by in missed if by > 1e-9]
    points = " points" if all(map(_is_rate, found)) else ""
    return f"missed by {' and '.join(left)}{points}" if left else "yes"
