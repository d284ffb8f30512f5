"""Paths of the MJCF parts, inside an installed wheel or next to `src/` in a checkout."""

import pathlib


def path(name: str) -> pathlib.Path:
    """Returns the file of one MJCF part, e.g. `arms/fr5/fr5.xml`; an absolute path is kept.

    Raises:
      FileNotFoundError: the part is missing; the message names all paths searched.
    """
    package = pathlib.Path(__file__).resolve().parents[1]
    places = [package / "mjcf" / name, package.parents[1] / "mjcf" / name]
    for place in places:
        if place.is_file():
            return place
    raise FileNotFoundError(f"MJCF part {name!r} is not in {places[0]} nor in {places[1]}")
