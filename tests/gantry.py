"""The arm of docs/howto/add-arm.md as an installed package, built from that page's blocks."""

import pathlib
import re

ROOT = pathlib.Path(__file__).parents[1]
_FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_GROUP = re.compile(r'entry-points\."([\w.]+)"\]\n(\w+) = "([\w.]+):(\w+)"')


def install(site: pathlib.Path) -> str:
    """Writes the package into `site`; returns the arm's name."""
    blocks = dict(_FENCE.findall((ROOT / "docs" / "howto" / "add-arm.md").read_text()))
    found = _GROUP.search(blocks["toml"])
    assert found
    group, name, module, attribute = found.groups()
    folder = site / module.partition(".")[0]
    folder.mkdir()
    (folder / "__init__.py").touch()
    (folder / "gantry.py").write_text(blocks["py"])
    (folder / "gantry.xml").write_text(blocks["xml"])
    info = site / "my_arms-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-arms\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{group}]\n{name} = {module}:{attribute}\n")
    return name
