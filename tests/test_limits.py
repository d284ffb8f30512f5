"""Ranges on the fields of settings: one law for all of them."""

import dataclasses
import math
import operator

import mistakes
import pytest

from starjax.cli import bench, evaluate, pack, sweep
from starjax.core import config, limits

STARTS = (config.RunConfig(), evaluate.EvaluateArgs(), sweep.SweepArgs(), bench.BenchArgs("x"))
RANGES = [
    (start, setting, found)
    for start in (*STARTS, pack.PackArgs("x", "y"))
    for setting in limits.fields(start)
    if (found := limits.within(setting[2]))
]


def changed(settings, path, value):
    """`settings` with another value of a nested field."""
    part, _, rest = path.partition(".")
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
    ("start", "setting", "limit"),
    RANGES,
    ids=[f"{type(start).__module__}.{setting[0]}" for start, setting, _ in RANGES],
)
def test_every_range_names_its_field_its_bounds_and_the_value(start, setting, limit):
    name, path, _ = setting
    several = isinstance(operator.attrgetter(path)(start), tuple)
    for number in inside(limit):
        limits.check(changed(start, path, (number,) if several else number))
    for number in outside(limit):
        value = (*inside(limit), number) if several else number
        with mistakes.of(name, number) as caught:
            limits.check(changed(start, path, value))
        bounds = {f"{limit.low:g}", f"{limit.high:g}", str(limit.high), "finite"}
        assert any(bound in caught.value.expected for bound in bounds)


def test_every_number_has_a_range():
    numbers = [
        name
        for start in STARTS
        for name, path, _ in limits.fields(start)
        if isinstance(operator.attrgetter(path)(start), int | float)
        and not isinstance(operator.attrgetter(path)(start), bool)
    ]
    ranged = {setting[0] for _, setting, _ in RANGES}
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
