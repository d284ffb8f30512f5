"""MJCF files of parts: reading, compiling and looking up names, with one line per mistake."""

import contextlib
from collections.abc import Iterator

import mujoco
import numpy as np

from starjax.core import errors
from starjax.sim import assets

# Sizes that MJX compiles in. Each part adds its own; the scene has the sum.
CONTACT_LIMITS = ("max_geom_pairs", "max_contact_points")


def read(part: str, mjcf: str) -> mujoco.MjSpec:
    """Reads the file of a part.

    Args:
      part: kind and name, e.g. `task lid`, the argument of errors.
      mjcf: as in the part's record.

    Raises:
      errors.UsageError: the file is missing or not MJCF.
    """
    try:
        path = assets.path(mjcf)
    except FileNotFoundError as error:
        raise errors.UsageError(f"{part}: mjcf", "a file", f"none: {error}") from error
    with explained(f"{part}: {path.name}"):
        return mujoco.MjSpec.from_file(str(path))


@contextlib.contextmanager
def explained(argument: str) -> Iterator[None]:
    """Turns an error of MuJoCo, or of the check of a model, into one line about `argument`."""
    try:
        yield
    except errors.UsageError:
        raise
    except ValueError as error:
        text = " ".join(str(error).split())
        raise errors.UsageError(argument, "a model that MuJoCo and MJX take", text) from error


def ids(part: str, m: mujoco.MjModel, kind: str, names: list[str]) -> np.ndarray:
    """Returns the ids of names in a model.

    Args:
      kind: `geom`, `body` or another kind of MuJoCo's named objects.

    Raises:
      errors.UsageError: a name is missing.
    """
    found = []
    for name in names:
        try:
            found.append(getattr(m, kind)(name).id)
        except KeyError as error:
            raise errors.UsageError(part, f"a {kind} named {name} in its MJCF", "none") from error
    return np.array(found, int)


def take_limits(part: mujoco.MjSpec) -> np.ndarray:
    """Removes the contact limits from a part and returns them."""
    sizes = np.zeros(len(CONTACT_LIMITS))
    for numeric in list(part.numerics):
        if numeric.name in CONTACT_LIMITS:
            sizes[CONTACT_LIMITS.index(numeric.name)] += numeric.data[0]
            part.delete(numeric)
    return sizes
