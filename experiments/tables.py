"""Draws tables of README.md, docs/ and benchmarks/, pages of results and model cards, from results.

    python experiments/tables.py            writes them
    python experiments/tables.py --check    fails if a page differs from the one drawn

A table stands between `<!-- table:NAME -->` and `<!-- /table -->`. NAME is `<folder>/<table>` of a
claim.toml, with some of its rows `<folder>/<table>:ROW,ROW`; `claims` (all pages); `presets` (from
their values); `leaderboard` and `elsewhere` (the trocar benchmark); `stress_levels`; a
`<name>.toml` of benchmarks/; or of benchmarks/results: `speed`, `stress_<policy>`,
`finetune_ways`, `finetune_runs`, `finetune_branches`, `monitor_<policy>`, `monitor_attempts`.
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
import leaderboard_page  # noqa: E402
import levels  # noqa: E402
import newest  # noqa: E402
import preset_table  # noqa: E402

from starjax.cli import model_card  # noqa: E402
from starjax.policies import packaged, policy_file  # noqa: E402

FINETUNED = {
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
        return claims.index()
    if name == "stress_levels":
        return levels.table()
    if name == "presets":
        return preset_table.table()
    if name in leaderboard_page.TABLES:
        return leaderboard_page.TABLES[name]()
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
    name, _, rows = name.partition(":")
    folder, _, name = name.rpartition("/")
    return claims.table(claims.load(HERE / folder), name, rows.split(",") if rows else None)


def pages() -> Iterator[tuple[Path, str]]:
    """Yields every page with drawn tables, and the text that it must hold."""
    for folder in claims.pages():
        page = claims.load(folder)
        yield folder / "README.md", claims.readme(page, table)
        if text := claims.further(page, table):
            yield folder / claims.TABLES, text
    marked = [ROOT / "README.md", ROOT / "benchmarks" / "README.md", HERE / "README.md"]
    for page in [*marked, *sorted((ROOT / "docs").rglob("*.md"))]:
        yield page, redraw(page.read_text(), table)
    for file in map(packaged.locate, packaged.names()):
        result = model_card.find_result(file)
        yield file.with_suffix(".md"), model_card.text(file.stem, policy_file.load(file), result)


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
