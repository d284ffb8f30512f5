"""Rows of data: a method and a preset."""

import dataclasses

from starjax.cli import presets
from starjax.core.methods import METHODS

BLIND = METHODS["dp_rcm4"]._replace(sees_trocar=False, weights_of="", label="", group="")
BRIEF = dataclasses.replace(
    presets.PRESETS["smoke"],
    demos=dataclasses.replace(presets.PRESETS["smoke"].demos, seen_trocars=4),
)
