"""Phrases and drawing of needle pick, for reports."""

from typing import Any

from starjax.sim.task import Outline, TaskText
from starjax.tasks import outlines

TEXT = TaskText(
    title="needle pick",
    done="picked up the needle",
    strict="lifted by 20 mm and held for 2 s without slipping by more than 0.5 mm, its point free, "
    "in time",
    loose="the needle was lifted by 20 mm, held or thrown",
    nearly="needle lifted, but it slipped or was not held for 2 s",
    collided="pressed jaws or shaft into the foam",
    ground="the foam",
    goal="the needle must be lifted",
)


def outline(mj_model: Any) -> Outline:
    """Returns the foam's rectangle."""
    return Outline((outlines.rectangle(mj_model, "foam"),), ())
