"""Rows of data: a method and a preset."""

import dataclasses

from starjax.commands import presets
from starjax.methods import METHODS

BLIND = METHODS["dp_rcm4"]._replace(sees_trocar=False, weights_of="", label="", group="")
BRIEF = dataclasses.replace(
    presets.PRESETS["smoke"],
    demos=dataclasses.replace(presets.PRESETS["smoke"].demos, seen_trocars=4),
)
