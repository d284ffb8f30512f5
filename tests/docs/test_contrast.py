"""Colours of links and code on the site's two schemes, against their backgrounds (WCAG 2.1, AA)."""

import importlib.util
import pathlib
import re

import pytest

LEAST = 4.5
# The theme's backgrounds of text and code, sRGB.
BACKGROUNDS = {
    "default": [(255, 255, 255), (245, 245, 245)],
    "slate": [(30, 33, 41), (39, 42, 53)],  # hsl(225, 15%, 14%) and 18%
}
KINDS = ("string", "keyword", "number", "function", "special", "constant")
NAMES = ("typeset-a", "accent-fg", *(f"code-hl-{kind}" for kind in KINDS))


def colours(scheme, root):
    """The theme's colours of a scheme, then ours: name -> sRGB."""
    place = pathlib.Path(importlib.util.find_spec("material").submodule_search_locations[0])
    files = sorted((place / "templates/assets/stylesheets").glob("*.css"))
    found = {}
    for text in (*(file.read_text() for file in files), (root / "docs/site.css").read_text()):
        for rule, body in re.findall(r"([^{}]+)\{([^{}]*)\}", text):
            if f"scheme={scheme}" in rule.replace('"', "") or ":root" in rule:
                named = re.findall(r"--md-([\w-]+)-color:\s*#([0-9a-f]{6})\b", body)
                found |= {n: tuple(bytes.fromhex(value)) for n, value in named}
    return found


def luminance(colour):
    parts = [v / 255 for v in colour]
    linear = [v / 12.92 if v <= 0.03928 else ((v + 0.055) / 1.055) ** 2.4 for v in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one, other):
    high, low = sorted((luminance(one), luminance(other)), reverse=True)
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("scheme", BACKGROUNDS)
def test_links_and_code_stand_out(scheme, pytestconfig):
    found = colours(scheme, pytestconfig.rootpath)
    text, code = BACKGROUNDS[scheme]
    ratios = {n: contrast(found[n], code if n.startswith("code") else text) for n in NAMES}
    assert min(ratios.values()) >= LEAST, ratios


def test_contrast_is_that_of_the_definition():
    assert contrast((0, 0, 0), (255, 255, 255)) == pytest.approx(21.0)
    assert contrast((119, 119, 119), (255, 255, 255)) == pytest.approx(4.48, abs=0.01)
