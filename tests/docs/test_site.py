"""The built site: its links lead somewhere, its films play, its equations are set."""

import os
import re
import subprocess
import sys
import urllib.parse

import pytest

FILM = re.compile(r"^\[[^\]]*\]\(\S+\.mp4\)$", re.MULTILINE)
RATE = re.compile(r"<td([^>]*)>[^<]*\d+/\d+: [\d.]+% \(")
HREF = re.compile(r'(?:href|src)="([^"#?]+)[^"]*"')


@pytest.fixture(scope="module")
def site(pytestconfig, tmp_path_factory):
    pytest.importorskip("mkdocs")
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "-q", "-d", str(out)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    subprocess.run(command, cwd=pytestconfig.rootpath, env=environment, check=True)
    return out


@pytest.mark.slow
def test_links_of_the_site_lead_somewhere(site):
    pages = [page for page in site.rglob("*.html") if page.name != "404.html"]
    count = 0
    for page in pages:
        for target in HREF.findall(page.read_text()):
            if ":" not in target:
                count += 1
                assert (page.parent / urllib.parse.unquote(target)).exists(), (page, target)
    assert len(pages) > 50 and count > 1000


@pytest.mark.slow
def test_search_films_equations_and_examples_are_there(site, pytestconfig):
    assert (site / "search" / "search_index.js").exists()  # read by pages without a server
    sources = [
        *pytestconfig.rootpath.glob("docs/**/*.md"),
        *pytestconfig.rootpath.glob("experiments/*/*.md"),
    ]
    films = sum(len(FILM.findall(page.read_text())) for page in sources)
    texts = [page.read_text() for page in site.rglob("*.html")]
    assert sum(text.count("<video") for text in texts) == films > 3
    assert not any(re.search(r'href="[^"]*\.mp4"', text) for text in texts)
    assert "<math" in (site / "understand" / "wrist.html").read_text()
    examples = {file.stem for file in pytestconfig.rootpath.glob("examples/*.py")}
    assert {page.stem for page in (site / "examples").glob("*.html")} == examples


@pytest.mark.slow
def test_intervals_are_in_cells_that_do_not_break(site):
    style = (site / "site.css").read_text()
    assert re.search(r'td\[style\*="right"\] \{ white-space: nowrap; \}', style)
    cells = [cell for page in site.rglob("*.html") for cell in RATE.findall(page.read_text())]
    assert len(cells) > 300 and all("right" in cell for cell in cells)


@pytest.mark.slow
def test_the_site_is_small(site, pytestconfig):
    """At most 35 written pages and 15 of results, besides examples and generated reference."""
    docs = pytestconfig.rootpath / "docs"
    generated = {docs / "reference" / f"{name}.md" for name in ("cli", "config", "parts")}
    written = [page for page in docs.rglob("*.md") if "api" not in page.parts]
    assert len(set(written) - generated) <= 35
    assert len(list((site / "results").glob("*.html"))) <= 16  # with the index
