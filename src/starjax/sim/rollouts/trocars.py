"""Configurations of trocars, fields `[C, A]`: one trocar for each arm, about that arm's nominal."""

import numpy as np

from starjax import rcm
from starjax.core import errors
from starjax.rcm.trocar import Trocar


def select(trocars: Trocar, rows: slice | np.ndarray) -> Trocar:
    """Selects some of the configurations."""
    return Trocar(*(field[rows] for field in trocars))


def listed(trocars: Trocar, arms: int) -> Trocar:
    """Returns concrete configurations as float32 fields `[C, A]`.

    Raises:
      ValueError: a trocar is invalid, or the fields are not `[C, arms]` with C >= 1.
    """
    rcm.check_trocar(trocars)
    fields = np.broadcast_arrays(*(np.asarray(field, np.float32) for field in trocars))
    shape = fields[0].shape
    if len(shape) != 2 or shape[1] != arms or not shape[0]:
        expected = f"fields [C, {arms}] of one configuration or more"
        raise errors.UsageError("trocars", expected, f"shape {list(shape)}")
    return Trocar(*fields)
