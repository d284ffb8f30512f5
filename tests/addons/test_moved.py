"""Imports that pages showed before add-ons: each fails with a new name, which exists."""

import importlib

import pytest

from starjax.core import moved

PAGES = """
from starjax.data.formats.base import Column, Format, Source
from starjax.deploy import crtk
from starjax.deploy import psm
from starjax.envs import playground
from starjax.sim import six_blocks
from starjax.sim.tissue import driving
from starjax.viewer import frame
import starjax.sim.thread
import starjax.finetune.settings
"""


@pytest.mark.parametrize("statement", PAGES.strip().splitlines())
def test_a_statement_names_the_new_module(statement):
    with pytest.raises(ModuleNotFoundError, match=r"^starjax\S* is now starjax\.addons") as caught:
        exec(statement)
    importlib.import_module(str(caught.value).rpartition(" ")[2])


@pytest.mark.parametrize("new", moved.NAMES.values())
def test_every_new_name_exists(new):
    importlib.import_module(f"starjax.{new}")
