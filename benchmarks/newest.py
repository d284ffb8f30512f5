"""The newest figure of every benchmark as one table: the rows of newest.toml, from results/."""

import json
import re
import tomllib
from pathlib import Path
from typing import Any

from starjax.report import formats

HERE = Path(__file__).parent
_VALUE = re.compile(r"\{([^:{}]+):?([^{}]*)\}")


def table() -> str:
    """The table as markdown.

    Raises:
      KeyError: a row names a value that its results do not have.
    """
    rows = [["Work", "Here", "Peer, same run", "Floor", "On"]]
    for said in tomllib.loads((HERE / "newest.toml").read_text())["rows"]:
        found = json.loads((HERE / "results" / f"{said['file']}.json").read_text())
        cells = [_filled(said.get(cell, ""), found) for cell in ("here", "peer", "floor")]
        rows.append([said["work"], *cells, formats.machine(found["hardware"])])
    return formats.render(rows, names=len(rows[0]))


def _filled(text: str, results: dict[str, Any]) -> str:
    """A template with its values in place."""

    def value(match: re.Match[str]) -> str:
        found: Any = results
        for key in match[1].split("/"):
            found = found[key]
        return f"{found / 1e6:#.3g}" if match[2] == "M" else format(found, match[2])

    return _VALUE.sub(value, text)
