"""Mappings that come with the package, one file each, found by a dataset's columns."""

from pathlib import Path

from starjax.addons.formats import mapping as maps
from starjax.addons.formats.base import Column, Source
from starjax.core import errors

FOLDER = Path(__file__).parent / "maps"
_SUFFIXES = (".toml", ".json")


def names() -> list[str]:
    """Returns the names of the mappings."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def find(name: str) -> Path:
    """Returns the file of a mapping: a path, or one of the package by its name.

    Raises:
      errors.UsageError: neither exists.
    """
    if Path(name).suffix in _SUFFIXES or Path(name).exists():
        return Path(name)
    errors.choice("--map", name, [*names(), "a .toml or .json file"])
    return FOLDER / f"{name}.toml"


def fitting(source: Source) -> list[str]:
    """Returns the mappings whose columns a dataset has."""
    return [name for name in names() if _fits(maps.load(find(name)), source)]


def choose(source: Source) -> str:
    """Returns the one mapping that fits a dataset.

    Raises:
      errors.UsageError: none does, or several do.
    """
    found = fitting(source)
    if len(found) != 1:
        got = f"{', '.join(found) or 'none'} that fits its columns"
        hint = "starjax inspect shows its columns, examples/10_data.py has a mapping"
        raise errors.UsageError("--map", f"a file, or one of {', '.join(names())}", got, hint)
    return found[0]


def _fits(mapping: maps.Map, source: Source) -> bool:
    return all(
        name in source.columns and _is_as(source.columns[name], expected)
        for name, expected in mapping.fits.items()
    )


def _is_as(column: Column, expected: int | tuple[str, ...]) -> bool:
    """Returns True for a column with these first names, or of this size; 0: any."""
    if isinstance(expected, tuple):
        return column.names[: len(expected)] == expected
    size = column.shape[0] if column.shape else 1
    return expected in (0, size)
