"""Phrases and drawing of endoscope tracking, for reports."""

from typing import TYPE_CHECKING

from starjax.sim.task import Outline, TaskText
from starjax.tasks import outlines

if TYPE_CHECKING:  # a robot loads tasks without the simulator
    import mujoco

TEXT = TaskText(
    title="endoscope tracking",
    done="kept the instrument's tip in the middle of the picture",
    strict="tip in the middle within 5% of the picture's side, picture level within 3 degrees, tip "
    "6 cm away within 20%, for 90% of the time from 2 s to 29 s",
    loose="the tip never left the picture from 2 s to 29 s",
    nearly="tip always in the picture, but not in its middle, level and 6 cm away for long enough",
    collided="touched tissue or the instrument with the endoscope",
    ground="the tissue",
    goal="the coloured tip belongs in the middle of the endoscope's picture",
    lost="the tip left the picture, and was not in its middle for long enough",
)
HALF = 0.085  # m, of the square that is drawn


def outline(mj_model: "mujoco.MjModel") -> Outline:
    """Returns a square of tissue and the vessels."""
    vessels = tuple(map(outlines.capsule_ends, outlines.named(mj_model, "vessel")))
    return Outline((HALF * outlines.CORNERS,), vessels)
