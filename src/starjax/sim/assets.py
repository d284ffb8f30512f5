"""Where the MJCF parts are: inside an installed wheel, or beside `src/` in a checkout."""

import pathlib


def path(name: str) -> pathlib.Path:
    """The file of one MJCF part, e.g. `arms/fr5/fr5.xml`, or an absolute path as it is.

    Raises:
      FileNotFoundError: the part is in no such place; all are named.
    """
    package = pathlib.Path(__file__).resolve().parents[1]
    places = [package / "mjcf" / name, package.parents[1] / "mjcf" / name]
    for place in places:
        if place.is_file():
            return place
    raise FileNotFoundError(f"MJCF part {name!r} is not in {places[0]} nor in {places[1]}")
