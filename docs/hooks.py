"""Pages generated with the site: from the settings, the results, the changelog."""

import re
from pathlib import Path

import parts
import settings
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "experiments"
IMAGES = (".png", ".gif")
# Page -> file of its text.
COPIES = {
    "changelog.md": "CHANGELOG.md",
    "contributing.md": "CONTRIBUTING.md",
    "explanation/benchmarks.md": "benchmarks/README.md",
    "reference/mjcf.md": "mjcf/README.md",
    "results/index.md": "experiments/README.md",
}
_LINK = re.compile(r"\[([^\]]*)\]\(([^)#\s]+)(#[^)]*)?\)")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Lists the pages of results in the navigation: those of `docs/results/`, then the claims."""
    pages = [f"results/{page.name}" for page in sorted((ROOT / "docs" / "results").glob("*.md"))]
    pages += [{title(folder): f"results/{folder.name}.md"} for folder in claims()]
    config.nav.append({"Results": ["results/index.md", *pages]})
    config.nav.append({"Project": ["contributing.md", "changelog.md"]})
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages and their images."""
    made = {
        "reference/cli.md": settings.commands(),
        "reference/config.md": settings.settings(),
        "reference/parts.md": parts.page(),
    }
    made |= {page: relinked(ROOT / source, page) for page, source in COPIES.items()}
    for folder in claims():
        page = f"results/{folder.name}.md"
        made[page] = relinked(folder / "README.md", page)
        for image in (path for path in folder.rglob("*") if path.suffix in IMAGES):
            name = f"results/{image.relative_to(RESULTS).as_posix()}"
            files.append(File.generated(config, name, abs_src_path=str(image)))
    for page, text in made.items():
        files.append(File.generated(config, page, content=text))
    return files


def claims() -> list[Path]:
    """Returns the folders of results that have a page."""
    return sorted(page.parent for page in RESULTS.glob("*/README.md"))


def title(folder: Path) -> str:
    """Returns the heading of a claim's page."""
    return (folder / "README.md").read_text().splitlines()[0].removeprefix("# ")


def relinked(source: Path, page: str) -> str:
    """Returns a text of the repository with links that hold in the site, and none to other files.

    Args:
      source: the text.
      page: its path in the site, relative to `docs/`.
    """
    pages = {(ROOT / path).resolve(): name for name, path in COPIES.items()}
    pages |= {(folder / "README.md").resolve(): f"results/{folder.name}.md" for folder in claims()}
    up = "../" * page.count("/")

    def link(match: re.Match) -> str:
        text, path, place = match[1], match[2], match[3] or ""
        target = (source.parent / path).resolve()
        if "://" in path:
            return match[0]
        if target in pages:
            return f"[{text}]({up}{pages[target]}{place})"
        if target.is_relative_to(ROOT / "docs"):
            return f"[{text}]({up}{target.relative_to(ROOT / 'docs').as_posix()}{place})"
        if target.suffix in IMAGES and target.is_relative_to(RESULTS):
            return f"[{text}]({up}results/{target.relative_to(RESULTS).as_posix()})"
        return text

    return _LINK.sub(link, source.read_text())
