"""Figures are the same bytes under any of the user's matplotlib settings."""

import os
import subprocess
import sys

import pytest

from starjax.core import methods
from starjax.report import style

# Draws a figure of every kind of element, light and dark, and prints the digest of its files.
DRAW = """
import hashlib
from starjax.report import stats, style

for dark in (False, True):
    with style.use(dark):
        figure = style.figure(3.0, 2.0)
        axis = figure.subplots()
        style.rates(axis, [1, 2], [stats.rate(3, 4), stats.rate(1, 4)], "stardiff", "a $b$")
        style.legend(figure, *axis.get_legend_handles_labels())
        style.percent_axis(axis)
    for kind in ("png", "pdf"):
        print(hashlib.sha256(style.save(figure, kind, dark)).hexdigest())
"""
HOSTILE = """
font.size: 31
font.family: serif
figure.dpi: 20
savefig.dpi: 10
savefig.bbox: tight
savefig.transparent: True
axes.facecolor: red
xtick.color: green
lines.linewidth: 9
text.usetex: True
path.simplify: False
pdf.compression: 0
axes.prop_cycle: cycler('color', ['y'])
"""


def drawn(setup="", **environment):
    clean = {k: v for k, v in os.environ.items() if k not in ("MPLBACKEND", "MATPLOTLIBRC")}
    done = subprocess.run(
        [sys.executable, "-c", setup + DRAW],
        env={**clean, "PYTHONPATH": os.pathsep.join(sys.path), **environment},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.fixture(scope="module")
def usual():
    digests = drawn()
    assert len(set(digests)) == 4
    return digests


@pytest.mark.parametrize(
    ("backend", "text"),
    [("module://nonsense", HOSTILE.encode()), ("svg", b"\xff\xfe\x00")],
    ids=["hostile", "no text"],
)
def test_the_users_backend_and_matplotlibrc_change_nothing(usual, tmp_path, backend, text):
    (tmp_path / "matplotlibrc").write_bytes(text)
    assert drawn(MPLBACKEND=backend, MATPLOTLIBRC=str(tmp_path)) == usual


def test_what_a_program_has_set_changes_nothing_and_stays(usual):
    setup = "import matplotlib\nmatplotlib.rcParams.update({'font.size': 30, 'lines.marker': 'o'})"
    after = "print(matplotlib.rcParams['font.size'] == 30)"
    assert drawn(f"{setup}\n{DRAW}\n{after}\n") == [*usual, "True", *usual]


def test_every_method_has_a_look_of_its_own():
    assert len({style.method(name) for name in methods.METHODS}) == len(methods.METHODS)
