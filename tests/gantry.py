"""The arm and the tool of docs/extend as installed packages, built from their pages' blocks."""

import pathlib
import re

ROOT = pathlib.Path(__file__).parents[1]
_FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_GROUP = re.compile(r'entry-points\."([\w.]+)"\]\n(\w+) = "([\w.]+):(\w+)"')


def install(site: pathlib.Path, page: str = "add-arm") -> str:
    """Writes a page's package into `site`; returns the name of its part."""
    blocks = dict(_FENCE.findall((ROOT / "docs" / "extend" / f"{page}.md").read_text()))
    entries = _GROUP.findall(blocks["toml"])
    _, name, module, _ = entries[0]
    package = module.partition(".")[0]
    folder = site / package
    folder.mkdir()
    (folder / "__init__.py").touch()
    (folder / f"{name}.py").write_text(blocks["py"])
    (folder / f"{name}.xml").write_text(blocks["xml"])
    info = site / f"{package}-1.0.dist-info"
    info.mkdir()
    about = f"Metadata-Version: 2.1\nName: {package.replace('_', '-')}\nVersion: 1.0\n"
    (info / "METADATA").write_text(about)
    groups = (f"[{group}]\n{row} = {module}:{found}\n" for group, row, module, found in entries)
    (info / "entry_points.txt").write_text("".join(groups))
    return name
