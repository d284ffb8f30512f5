"""Draws the tables of README.md, docs/ and benchmarks/ and the pages of claims, from results.

    python experiments/tables.py            writes them
    python experiments/tables.py --check    fails if one of them is not what would be written

A table stands between `<!-- table:NAME -->` and `<!-- /table -->`. NAME is `<claim>/<table>` of a
claim.toml, `claims` (the list of claims), `presets` (from their values), or of benchmarks/results:
`speed`, `learners`, `experts`, `six_blocks`, `scenes`, `stress_compact`, `stress_randomised`,
`proposition`, `ppo`, `ppo_gpu`, `sb3`, `through_lerobot`.
"""

import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path[:0] = [str(HERE), str(ROOT / "benchmarks")]

import claims  # noqa: E402
import newest  # noqa: E402
import preset_table  # noqa: E402

_BLOCK = re.compile(r"(<!-- table:(\S+) -->\n).*?(<!-- /table -->)", re.DOTALL)


def redraw(text: str, draw: Callable[[str], str]) -> str:
    """`text` with every marked table drawn anew."""
    return _BLOCK.sub(lambda found: f"{found[1]}{draw(found[2])}\n{found[3]}", text)


def table(name: str) -> str:
    """A table by its name in the markers; KeyError where there is none."""
    if name == "claims":
        return claims.index([claims.load(folder) for folder in claims.folders()])
    if name == "presets":
        return preset_table.table()
    if name == "speed":
        return newest.table()
    if (HERE.parent / "benchmarks" / f"{name}.toml").exists():
        return newest.other(name)
    if name.startswith("stress"):
        return newest.stress(name)
    folder, _, which = name.partition("/")
    return claims.table(claims.load(HERE / folder), which)


def pages() -> Iterator[tuple[Path, str]]:
    """Every page with something drawn in it, and what it must hold."""
    for folder in claims.folders():
        yield folder / "README.md", claims.readme(claims.load(folder))
    marked = [ROOT / "README.md", ROOT / "benchmarks" / "README.md", HERE / "README.md"]
    for page in [*marked, *sorted((ROOT / "docs").rglob("*.md"))]:
        yield page, redraw(page.read_text(), table)


def main() -> int:
    """Writes the pages, or with --check names those that differ."""
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
