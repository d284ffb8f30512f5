"""Measured trocars, as the owner of a robot writes them."""

import numpy as np
from jax.typing import ArrayLike

from starjax import rcm
from starjax.core.errors import UsageError
from starjax.deploy.inputs import InputSpec, check_trocar


def read(trocar: rcm.Trocar | ArrayLike, spec: InputSpec) -> rcm.Trocar:
    """Returns trocars of all arms, given as parameters or as positions `[*arms, 3]` m."""
    arms = spec.arms
    if not isinstance(trocar, rcm.Trocar):
        place = np.asarray(trocar)
        if place.dtype.kind not in "fiu" or place.shape != (*arms, 3):
            expected = f"an rcm.Trocar or positions {[*arms, 3]} in m"
            raise UsageError("trocar", expected, f"{type(trocar).__name__} {list(place.shape)}")
        trocar = rcm.trocar_from_position(np.asarray(place, np.float32), spec.p_world_ref)
    trocar = rcm.check_trocar(rcm.Trocar(*(np.asarray(x, np.float32) for x in trocar)))
    shapes = [np.shape(x) for x in trocar]
    if np.broadcast_shapes(*shapes) not in {(), arms}:
        raise UsageError("trocar", f"fields of shape {list(arms)}", shapes)
    trocar = rcm.Trocar(*(np.broadcast_to(x, arms) for x in trocar))
    check_trocar(spec, trocar)
    return trocar
