"""Phrases and drawing of needle regrasp, for reports."""

from typing import Any

from starjax.sim.task import Outline, TaskText
from starjax.tasks import outlines

TEXT = TaskText(
    title="needle regrasp",
    done="took the tilted needle for driving",
    strict="held a third from its swage within 0.1 of its length, square to the "
    "jaws within 15 degrees, lifted by 20 mm for 2 s without slipping by more than 0.5 mm, in time",
    loose="the needle was lifted by 20 mm, however it was held",
    nearly="needle lifted, but held elsewhere, askew, with slip or not for 2 s",
    collided="pressed jaws, palm or shaft into the table",
    ground="the foam",
    goal="the needle must be lifted, held a third from its swage",
)


def outline(mj_model: Any) -> Outline:
    """Returns the rectangle of the foam below the plate."""
    return Outline((outlines.rectangle(mj_model, "foam"),), ())
