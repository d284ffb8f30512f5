"""Slots of two opposite arms, and the twelve pairs of their trocars.

The trocars of any pair in the workspaces `left` and `right` are 100 to 170 mm apart, and shafts
through them that meet at the middle of the board enclose 37 to 60 degrees, as surgeons choose. If
they were nearer, shafts and wrists would collide.
"""

import numpy as np

from starjax import rcm
from starjax.sim.task import Slot

SLOTS = (
    Slot(workspace="left", p_world_ref=(0.0, 0.0, 0.15)),
    Slot(workspace="right", p_world_ref=(0.0, 0.0, 0.15), roll_zero=float(np.pi)),
)

# Left and right trocar, `(mm, deg, deg)`, azimuths from each arm's own side.
_PAIRS = (
    ((61, 88, -11), (76, 92, 4)),
    ((76, 92, -4), (69, 88, -11)),
    ((69, 90, 4), (61, 91, 11)),
    ((80, 89, 11), (61, 89, -4)),
    ((58, 92, 7), (58, 88, 7)),
    ((65, 88, 0), (80, 90, -7)),
    ((80, 91, -7), (73, 91, 11)),
    ((73, 89, 11), (65, 92, 0)),
    # Unseen: the farthest and the nearest corners, one of each, and the middle.
    ((84, 87, -15), (84, 93, 15)),
    ((54, 93, 15), (54, 87, -15)),
    ((84, 93, 15), (54, 87, 15)),
    ((69, 90, 0), (69, 90, 0)),
)


def _trocars() -> rcm.Trocar:
    radius, polar, aside = np.moveaxis(np.array(_PAIRS, np.float64), -1, 0)
    azimuth = aside + np.array([180.0, 0.0])
    fields = (radius / 1000.0, np.deg2rad(polar), np.deg2rad(azimuth))
    return rcm.Trocar(*(field.astype(np.float32) for field in fields))


TROCARS = _trocars()
