"""Tables of the trocar benchmark's page: our rows, and figures of other papers."""

import json
import tomllib
from pathlib import Path

from starjax.report import formats, leaderboard, leaderboard_tables

HERE = Path(__file__).parent
# Reports of fine-tunings: they name the steps of the fine-tuning, not those of the policy.
FINETUNED = "fine_tuning"
# Names of the row of another project's policy, which was scored over a socket.
SERVED = {
    "Served policy": "ACT (LeRobot)",
    "ws://127.0.0.1:8765": "served, from states, 6,000 steps",
    "ws://127.0.0.1:8000": "served, from states, 30,000 steps",
}
_ELSEWHERE = ("work", "figure", "n", "where", "differs", "ours", "source", "seen")


def ours() -> str:
    """Returns the table of all results that name this version of the benchmark."""
    files = [file for file in sorted(HERE.rglob("*.json")) if FINETUNED not in file.parts]
    named = [file for file in files if _version(file)]
    rows = leaderboard_tables.current(leaderboard.read(named)[0])
    table = [[SERVED.get(cell, cell) for cell in line] for line in leaderboard_tables.table(rows)]
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
