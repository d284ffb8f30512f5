"""Configurations of trocars, fields `[C, A]`: one trocar for each arm, about that arm's nominal."""

import numpy as np

from starjax import errors, rcm
from starjax.rcm.trocar import IS_SEEN, TROCARS, Trocar


def twelve(arms: int = 1) -> Trocar:
    """The twelve of section V-A2 for each arm, those of `rcm.IS_SEEN` first: fields `[12, A]`.

    A further arm has them in another order, in which seen ones stay seen.
    """
    seen = np.flatnonzero(IS_SEEN)
    unseen = np.flatnonzero(~IS_SEEN)
    rows = np.stack([np.r_[np.roll(seen, -a), np.roll(unseen, -a)] for a in range(arms)], -1)
    return Trocar(*(field[rows] for field in TROCARS))


def select(trocars: Trocar, rows: slice | np.ndarray) -> Trocar:
    """Some of the configurations."""
    return Trocar(*(field[rows] for field in trocars))


def listed(trocars: Trocar, arms: int) -> Trocar:
    """Concrete configurations as float32 fields `[C, A]`.

    Raises:
      ValueError: a trocar is none, there are none, or they are not `[C, arms]`.
    """
    rcm.check_trocar(trocars)
    fields = np.broadcast_arrays(*(np.asarray(field, np.float32) for field in trocars))
    shape = fields[0].shape
    if len(shape) != 2 or shape[1] != arms or not shape[0]:
        expected = f"fields [C, {arms}] of one configuration or more"
        raise errors.UsageError("trocars", expected, f"shape {list(shape)}")
    return Trocar(*fields)
