"""Draws the tables of README.md, docs/ and benchmarks/ and the pages of claims, from results.

    python experiments/tables.py            writes them
    python experiments/tables.py --check    fails if a page differs from the one drawn

A table stands between `<!-- table:NAME -->` and `<!-- /table -->`. NAME is `<claim>/<table>` of a
claim.toml, with some of its rows `<claim>/<table>:ROW,ROW`; `claims` (the list of claims);
`presets` (from their values); `goals_...` (of goals_page.py and goals_list.py); `leaderboard`,
`leaderboard_apart` and `elsewhere` (the trocar benchmark); or of benchmarks/results: `speed`,
`learners`, `experts`, `six_blocks`, `scenes`, `stress_compact`, `stress_robust`, `stress_higher`,
`stress_randomised`, `proposition`, `finetune_goals`, `finetune_ways`, `finetune_runs`,
`finetune_branches`, `ppo`, `ppo_gpu`, `sb3`, `monitor_<policy>`, `monitor_cost`,
`monitor_attempts`, `through_lerobot`, `held_out`, `larger_than_memory`, `loaders`, `redraw`,
`look`, `physics_goals`, `gradient_noise`, `ring_starts`, `handover_passes`.
"""

import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path[:0] = [str(HERE), str(ROOT / "benchmarks")]

import claims  # noqa: E402
import finetuned  # noqa: E402
import goals_list  # noqa: E402
import goals_page  # noqa: E402
import leaderboard_page  # noqa: E402
import newest  # noqa: E402
import preset_table  # noqa: E402

FINETUNED = {
    "finetune_goals": finetuned.goals,
    "finetune_ways": finetuned.ways,
    "finetune_runs": finetuned.runs,
    "finetune_branches": finetuned.branches,
}
_BLOCK = re.compile(r"(<!-- table:(\S+) -->\n).*?(<!-- /table -->)", re.DOTALL)


def redraw(text: str, draw: Callable[[str], str]) -> str:
    """Redraws every marked table of `text`."""
    return _BLOCK.sub(lambda match: f"{match[1]}{draw(match[2])}\n{match[3]}", text)


def table(name: str) -> str:
    """Returns the table of a marker's name, KeyError for an unknown one."""
    if name == "claims":
        return claims.index([claims.load(folder) for folder in claims.folders()])
    if name == "presets":
        return preset_table.table()
    if name in leaderboard_page.TABLES:
        return leaderboard_page.TABLES[name]()
    if name in goals_page.TABLES:
        return goals_page.TABLES[name]()
    if name.startswith(goals_list.PREFIX):
        return goals_list.table(name)
    if name in FINETUNED:
        return FINETUNED[name]()
    if name == "speed":
        return newest.table()
    if (HERE.parent / "benchmarks" / f"{name}.toml").exists():
        return newest.other(name)
    if name.startswith("stress"):
        return newest.stress(name)
    if name == "monitor_attempts":
        return newest.monitor_attempts()
    if name.startswith("monitor"):
        return newest.monitor(name)
    folder, _, rest = name.partition("/")
    name, _, rows = rest.partition(":")
    return claims.table(claims.load(HERE / folder), name, rows.split(",") if rows else None)


def pages() -> Iterator[tuple[Path, str]]:
    """Yields every page with drawn tables, and the text that it must hold."""
    for folder in claims.folders():
        yield folder / "README.md", claims.readme(claims.load(folder))
    marked = [ROOT / "README.md", ROOT / "benchmarks" / "README.md", HERE / "README.md"]
    marked.append(HERE / "goals" / "README.md")
    for page in [*marked, *sorted((ROOT / "docs").rglob("*.md"))]:
        yield page, redraw(page.read_text(), table)


def main() -> int:
    """Writes the pages that differ, or with --check names them."""
    stale = [
        (page, text) for page, text in pages() if not page.exists() or page.read_text() != text
    ]
    for page, text in stale:
        print(page.relative_to(ROOT))
        if "--check" not in sys.argv:
            page.write_text(text)
    return int("--check" in sys.argv and bool(stale))


if __name__ == "__main__":
    sys.exit(main())
