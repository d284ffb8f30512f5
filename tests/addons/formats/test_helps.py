"""The helps of export and import name every format."""

import re

import pytest

from starjax import cli
from starjax.addons.formats import base


@pytest.mark.parametrize(
    ("command", "names"), [("export", base.writable), ("import", base.FORMATS.names)]
)
def test_help_names_every_format(command, names, capsys):
    with pytest.raises(SystemExit):
        cli.dispatch([command, "--help-all"])
    shown = capsys.readouterr().out.replace("│", " ").split("--format STR")[1].split("--")[0]
    words = set(re.findall(r"[a-z][\w.-]*\w", shown))
    assert set(names()) <= words
    assert set(base.FORMATS.names()) & words == set(names())
