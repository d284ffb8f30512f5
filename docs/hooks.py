"""Builds pages from files outside docs/, and rewrites links that lead there.

Links are written as they work in a checkout. A page `<!-- generated: NAME -->` gets the tables of
NAME in place of the mark, a paragraph of one link to a film becomes a player, and a block of
`math`, which code hosts set, becomes MathML.
"""

import ast
import re
import sys
from pathlib import Path

import parts
import settings
from latex2mathml import converter
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "experiments"
sys.path.insert(0, str(RESULTS))

import claims  # noqa: E402

IMAGES = (".png", ".gif")
# Page of the site -> file of its text.
COPIES = {
    "changelog.md": "CHANGELOG.md",
    "reference/benchmarks.md": "benchmarks/README.md",
    "reference/mjcf.md": "mjcf/README.md",
    "results/index.md": "experiments/README.md",
} | {f"results/{page.name}.md": f"experiments/{page.name}/README.md" for page in claims.pages()}
EXAMPLES = {f"examples/{file.stem}.md": file for file in sorted((ROOT / "examples").glob("*.py"))}
GENERATED = {
    "commands": settings.commands,
    "settings": settings.settings,
    "parts": parts.page,
}
_LINK = re.compile(r"\[([^\]]*)\]\(([^)#\s]+)(#[^)]*)?\)")
_MARK = re.compile(r"<!-- generated: (\w+) -->")
_FILM = re.compile(r"^\[([^\]]*)\]\((\S+\.mp4)\)$", re.MULTILINE)
_MATH = re.compile(r"^```math\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_PLAYER = '<video{} controls muted playsinline preload="metadata" src="{}" aria-label="{}"></video>'


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Lists the examples and, in the order of the paper, the results in the navigation."""
    config.nav.insert(2, {"Examples": list(EXAMPLES)})
    groups = [
        {group: [f"results/{name}.md" for name in names]} for group, names in claims.GROUPS.items()
    ]
    config.nav.append({"Results": ["results/index.md", *groups]})
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages from outside docs/ and the pictures of results."""
    for page, source in COPIES.items():
        text = relinked((ROOT / source).read_text(), ROOT / source, page)
        files.append(File.generated(config, page, content=text))
    for page, source in EXAMPLES.items():
        files.append(File.generated(config, page, content=example(source)))
    for image in (path for path in RESULTS.rglob("*") if path.suffix in IMAGES):
        name = f"results/{image.relative_to(RESULTS).as_posix()}"
        files.append(File.generated(config, name, abs_src_path=str(image)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Rewrites links, fills generated tables in, and sets films and equations."""
    source = ROOT / "docs" / page.file.src_uri
    if page.file.src_uri not in COPIES | EXAMPLES:
        markdown = relinked(markdown, source, page.file.src_uri)
    markdown = _MARK.sub(lambda match: GENERATED[match[1]](), markdown)
    markdown = _MATH.sub(lambda match: converter.convert(match[1], display="block"), markdown)
    place = ' class="at-right"' if page.is_homepage else ""
    return _FILM.sub(lambda match: _PLAYER.format(place, match[2], match[1]), markdown)


def example(source: Path) -> str:
    """Returns the page of an example: its docstring, its command and its code."""
    text = source.read_text()
    head, _, rest = (ast.get_docstring(ast.parse(text)) or "").partition("\n\n")
    number, _, name = source.stem.partition("_")
    code = text.split('"""', 2)[2].strip()
    parts = [
        "---",
        f"title: {int(number)}. {name.replace('_', ' ')}",
        "---",
        f"# {head.rstrip('.')}",
    ]
    parts += ["", rest, "", f"```bash\npython examples/{source.name}\n```"]
    return "\n".join([*parts, "", f"```python\n{code}\n```", ""])


def relinked(text: str, source: Path, page: str) -> str:
    """Returns a text with links that hold in the site, and none to files outside it.

    Args:
      text: Markdown with links that hold in a checkout.
      source: its file.
      page: its path in the site, relative to `docs/`.
    """
    pages = {(ROOT / path).resolve(): name for name, path in (COPIES | EXAMPLES).items()}
    up = "../" * page.count("/")

    def link(match: re.Match) -> str:
        label, path, place = match[1], match[2], match[3] or ""
        target = (source.parent / path).resolve()
        if "://" in path:
            return match[0]
        if target in pages:
            return f"[{label}]({up}{pages[target]}{place})"
        if target.is_relative_to(ROOT / "docs"):
            return f"[{label}]({up}{target.relative_to(ROOT / 'docs').as_posix()}{place})"
        if target.suffix in IMAGES and target.is_relative_to(RESULTS):
            return f"[{label}]({up}results/{target.relative_to(RESULTS).as_posix()})"
        return label

    return _LINK.sub(link, text)
