"""Typed values from JSON; an error names the file and the field."""

import re
from pathlib import Path
from typing import TypeVar

import msgspec

from starjax.core import errors

T = TypeVar("T")
_PLACE = re.compile(r" - at `\$\.?(.*)`$")
_MISSING = re.compile(r"Object missing required field `(.*)`")
_EXPECTED = re.compile(r"Expected (.*), got (.*)")


def convert(file: Path, value: object, kind: type[T], place: str = "") -> T:
    """Converts JSON values to `kind`, e.g. a `msgspec.Struct`; fields that it lacks are ignored.

    Args:
      file: source of the value, for errors.
      place: of the value in the file, for errors.

    Raises:
      errors.UsageError: a field is missing or of another type.
    """
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        # msgspec has the field only in its message: "Expected `int`, got `str` - at `$.a[3].b`".
        text = str(error)
        located = _PLACE.search(text)
        fields = [place, located[1] if located else ""]
        text = _PLACE.sub("", text)
        expected, got = "a value", "nothing"
        if missing := _MISSING.fullmatch(text):
            fields.append(missing[1])
        elif mismatch := _EXPECTED.fullmatch(text):
            expected, got = (part.replace("`", "") for part in mismatch.groups())
        else:
            expected, got = "a valid value", text
        field = ".".join(filter(None, fields))
        raise errors.UsageError(f"{file}: {field}" if field else str(file), expected, got) from None
