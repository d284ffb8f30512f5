"""Tables of the trocar benchmark's page: our rows, rows apart, and figures of other papers."""

import json
import tomllib
from pathlib import Path

import claims

from starjax.report import formats, leaderboard, leaderboard_tables

HERE = Path(__file__).parent
# Claims whose results were recorded before the benchmark had versions, with its trials.
BEFORE = ("task_methods", "all_methods", "learners")
# Reports of fine-tunings: they name the steps of the fine-tuning, not those of the policy.
FINETUNED = "finetuned"
_ELSEWHERE = ("work", "figure", "n", "where", "differs", "ours", "source", "seen")


def ours() -> str:
    """Returns the table of all results that name this version of the benchmark."""
    files = [file for file in sorted(HERE.rglob("*.json")) if FINETUNED not in file.parts]
    named = [file for file in files if _version(file)]
    rows = leaderboard_tables.current(leaderboard.read(named)[0])
    return leaderboard_tables.body(rows) if rows else "No committed result yet."


def apart() -> str:
    """Returns the table of the claims' results without a version, and the sentence about them."""
    runs = [run.run for name in BEFORE for run in claims.load(HERE / name).runs.values()]
    files = [run.path for run in runs]
    files += [file.with_name("sweep.json") for file in files if file.name == "result.json"]
    known = sorted({file.resolve() for file in files if file.is_file()})
    rows = leaderboard_tables.apart(leaderboard.read(known)[0])
    return f"{leaderboard_tables.reason(rows)}\n\n{leaderboard_tables.body(rows)}"


def elsewhere() -> str:
    """Returns the table of published figures."""
    header = ["Work", "Figure", "n", "Where", "Differs", "Nearest task here", "Source", "Read"]
    rows = tomllib.loads((HERE / "elsewhere.toml").read_text())["rows"]
    body = [[row[name] or leaderboard_tables.NONE for name in _ELSEWHERE] for row in rows]
    return formats.render([header, *body], names=len(header))


def _version(file: Path) -> int | None:
    return json.loads(file.read_bytes()).get("benchmark_version")


TABLES = {"leaderboard": ours, "leaderboard_apart": apart, "elsewhere": elsewhere}
