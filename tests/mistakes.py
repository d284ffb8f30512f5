"""A user's mistake, by its fields: how it is worded is tested in test_errors.py alone."""

import contextlib
from collections.abc import Iterator

import pytest

from starjax.core import errors


@contextlib.contextmanager
def of(argument: str, got: object = "") -> Iterator[pytest.ExceptionInfo[errors.UsageError]]:
    """Expects a mistake of `argument` with `got` in its value, in one line."""
    with pytest.raises(errors.UsageError) as caught:
        yield caught
    error = caught.value
    assert error.argument == argument and str(got) in str(error.got), error
    assert "\n" not in str(error)
