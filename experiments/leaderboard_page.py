"""Tables of the trocar benchmark's page: our rows, and figures of other papers."""

import json
import tomllib
from pathlib import Path

from starjax.report import formats, leaderboard, leaderboard_tables

HERE = Path(__file__).parent
# Reports of fine-tunings: they name the steps of the fine-tuning, not those of the policy.
FINETUNED = "fine_tuning"
# Policies of another project, scored over a socket: digest -> method and policy.
SERVED = {
    "d0a136d3": ["ACT (LeRobot)", "served, from states, 6,000 steps"],
    "9be6f1d2": ["ACT (LeRobot)", "served, from states, 30,000 steps"],
}
_ELSEWHERE = ("work", "figure", "n", "where", "differs", "ours", "source", "seen")


def ours() -> str:
    """Returns the table of all results that name this version of the benchmark."""
    files = [file for file in sorted(HERE.rglob("*.json")) if FINETUNED not in file.parts]
    named = [file for file in files if _version(file)]
    rows = leaderboard_tables.current(leaderboard.read(named)[0])
    table = leaderboard_tables.table(rows)
    for row, line in zip(rows, table[1:], strict=True):
        line[1:3] = SERVED.get(row.weights, line[1:3])
    numbered = enumerate(leaderboard_tables.commands(rows), 1)
    commands = "\n".join(f"{number}. `{command}`" for number, command in numbered)
    return f"{formats.render(table, names=3)}\n\n{commands}"


def elsewhere() -> str:
    """Returns the table of published figures."""
    header = ["Work", "Figure", "n", "Where", "Differs", "Nearest task here", "Source", "Read"]
    rows = tomllib.loads((HERE / "elsewhere.toml").read_text())["rows"]
    body = [[row[name] or leaderboard_tables.NONE for name in _ELSEWHERE] for row in rows]
    return formats.render([header, *body], names=len(header))


def _version(file: Path) -> int | None:
    return json.loads(file.read_bytes()).get("benchmark_version")


TABLES = {"leaderboard": ours, "elsewhere": elsewhere}
