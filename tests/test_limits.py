"""Ranges on the fields of settings: one law for all of them."""

import dataclasses
import math
import operator

import mistakes
import pytest

from starjax import config, limits
from starjax.experiments import bench, evaluate, pack, sweep

STARTS = (config.RunConfig(), evaluate.Options(), sweep.Options("x"), bench.Options("x"))
RANGES = [
    (start, name, found)
    for start in (*STARTS, pack.Options("x", "y"))
    for name, hint in limits.fields(type(start))
    if (found := limits.within(hint))
]


def changed(settings, name, value):
    """`settings` with another value of a nested field."""
    part, _, rest = name.partition(".")
    value = changed(getattr(settings, part), rest, value) if rest else value
    return dataclasses.replace(settings, **{part: value})


def outside(limit):
    """Numbers next to the range, on either side."""
    if isinstance(limit.low, float):
        yield limit.low if limit.ends[0] == "(" else math.nextafter(limit.low, -math.inf)
        yield limit.high if limit.ends[1] == ")" else math.nextafter(limit.high, math.inf)
        yield math.nan
    else:
        yield from (limit.low - 1, limit.high + 1, 2**70)
        yield from [limit.low + 1] * (limit.step > 1)


def inside(limit):
    if isinstance(limit.low, float):
        yield limit.low if limit.ends[0] == "[" else math.nextafter(limit.low, math.inf)
        yield limit.high if limit.ends[1] == "]" else math.nextafter(limit.high, -math.inf)
    else:
        yield from (limit.low, limit.low + limit.step, limit.high)


@pytest.mark.parametrize(
    ("start", "name", "limit"), RANGES, ids=[f"{type(s).__module__}.{n}" for s, n, _ in RANGES]
)
def test_every_range_names_its_field_its_bounds_and_the_value(start, name, limit):
    several = isinstance(operator.attrgetter(name)(start), tuple)
    for number in inside(limit):
        limits.check(changed(start, name, (number,) if several else number))
    for number in outside(limit):
        value = (*inside(limit), number) if several else number
        with mistakes.of(name, number) as caught:
            limits.check(changed(start, name, value))
        bounds = {f"{limit.low:g}", f"{limit.high:g}", str(limit.high), "finite"}
        assert any(bound in caught.value.expected for bound in bounds)


def test_every_number_has_a_range():
    numbers = [
        name
        for start in STARTS
        for name, _ in limits.fields(type(start))
        if isinstance(operator.attrgetter(name)(start), int | float)
        and not isinstance(operator.attrgetter(name)(start), bool)
    ]
    ranged = {name for _, name, _ in RANGES}
    assert len(numbers) > 40 and set(numbers) <= ranged


@pytest.mark.parametrize(
    ("limit", "text"),
    [
        (limits.Range(1, 8), "1 to 8"),
        (limits.Range(4, 64, step=2), "4, 6, ... 64"),
        (limits.Range(0, limits.MOST), "0 or more"),
        (limits.Range(0.0, 1.0, "(]"), "in (0, 1]"),
        (limits.Range(0.0, math.inf, "()"), "more than 0"),
    ],
)
def test_a_range_in_words(limit, text):
    assert str(limit) == text
