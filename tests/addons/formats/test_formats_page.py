"""The page's table of formats, against the formats."""

import pathlib

from starjax.addons.formats import base

PAGE = pathlib.Path(__file__).parents[3] / "docs" / "use" / "formats.md"
HEADER = "| format | read | written | byte-exact round trip |"


def rows():
    lines = iter(PAGE.read_text().split("\n"))
    next(line for line in lines if line.startswith(HEADER))
    next(lines)
    for line in lines:
        if not line:
            return
        yield [cell.strip() for cell in line.strip("|").split("|")]


def test_each_format_has_a_row_that_says_if_it_is_written():
    table = {name.strip("`"): cells for name, *cells in rows()}
    assert table.keys() == set(base.FORMATS.built_in)
    for name, (read, written, exact, caught) in table.items():
        is_written = base.FORMATS.get(name).write is not None
        assert (written != "no") == is_written == (exact != "–"), name
        assert read and caught, name
