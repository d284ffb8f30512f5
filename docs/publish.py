"""Writes the repository's address where the pages name it, and the badges of README.md.

    python docs/publish.py https://github.com/OWNER/starjax

The address stands in pyproject.toml, `[project.urls]`; every other file repeats it.
"""

import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FILES = ("README.md", "pyproject.toml", "docs/index.md", "examples/quickstart.ipynb")
BADGE = """<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="20" role="img">
<title>{name}: {value}</title><rect rx="3" width="{width}" height="20" fill="#00594f"/>
<rect rx="3" width="{split}" height="20" fill="#424a52"/>
<g fill="#fff" font-family="Verdana,DejaVu Sans,sans-serif" font-size="11">
<text x="6" y="14">{name}</text><text x="{at}" y="14">{value}</text></g></svg>
"""


def address() -> str:
    """Returns the address of pyproject.toml."""
    return _project()["urls"]["Source"]


def slug(url: str) -> str:
    """Returns owner and name, which links to a notebook repeat: the last two parts."""
    return "/".join(url.removesuffix(".git").rsplit("/", 2)[-2:])


def badges() -> dict[str, str]:
    """Returns name -> value, from pyproject.toml."""
    project = _project()
    pythons = [x.rpartition(" ")[2] for x in project["classifiers"] if " :: 3." in x]
    (jax,) = (x.removeprefix("jax") for x in project["dependencies"] if x.startswith("jax"))
    return {
        "licence": project["license"],
        "python": f"{pythons[0]} to {pythons[-1]}",
        "jax": jax.replace(">=", "").replace(",<", " to below "),
    }


def draw(name: str, value: str) -> str:
    """Returns a badge as SVG."""
    split, width = 12 + 7 * len(name), 26 + 7 * (len(name) + len(value))
    return BADGE.format(name=name, value=value, split=split, width=width, at=split + 7)


def main(new: str) -> None:
    old = address()
    for file in FILES:
        text = (ROOT / file).read_text()
        (ROOT / file).write_text(text.replace(old, new).replace(slug(old), slug(new)))
    for name, value in badges().items():
        (ROOT / "docs" / "images" / f"badge_{name}.svg").write_text(draw(name, value))


def _project() -> dict:
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


if __name__ == "__main__":
    main(sys.argv[1] if sys.argv[1:] else address())
