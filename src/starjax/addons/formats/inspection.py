"""Other people's datasets in `starjax inspect` and `starjax list`."""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from starjax.addons.formats import base, mapping, own_columns, ready, timing
from starjax.cli import list_command
from starjax.cli.inspect_command import Found, spread
from starjax.cli.list_command import Row
from starjax.core import errors
from starjax.runtime import progress

_LOOKED_AT = 50  # episodes of a foreign dataset whose values are read


def summary(path: Path) -> Found:
    import numpy as np

    from starjax.data import stillness

    name = base.detect(path)
    with base.open_dataset(path, name) as source:
        lengths = sorted(source.lengths)
        rate = f"{source.hz:g} Hz" if source.hz else "unknown"
        comes = "starjax export: starjax import brings it back" if source.origin else "others"
        rows = [
            ("dataset", base.FORMATS.get(name).description),
            ("from", comes),
            ("task", source.task),
            ("episodes", f"{len(lengths)}, {sum(lengths)} frames"),
            ("lengths", spread(lengths, " steps")),
            ("rate", rate),
        ]
        low = [column for column, about in source.columns.items() if not about.is_image]
        ranges = {column: _Numbers() for column in low}
        unread, timed = [], []
        actions = [c for c in low if "action" in c and source.columns[c].dtype.startswith("float")]
        rests = []
        for episode in range(min(len(lengths), _LOOKED_AT)):  # one at a time in memory
            try:
                arrays = source.read(episode, low)
            except errors.UsageError as error:
                unread.append(str(error))
                continue
            for column, values in arrays.items():
                ranges[column].add(episode, values)
            odd = timing.anomalies(source, episode, arrays)
            timed += [f"episode {episode}: {line}" for line in odd]
            if actions:
                flat = [arrays[c].reshape(len(arrays[c]), -1) for c in actions]
                rests.append(stillness.of_numbers(np.concatenate(flat, axis=-1)))
        rows.append(("rests", stillness.text(rests)))
        rows += [
            (f"  {column}", _said(about, ranges.get(column)))
            for column, about in source.columns.items()
        ]
        return Found(rows, [*source.notes, *unread, *timed, *_odd(ranges)])


@dataclasses.dataclass
class _Numbers:
    """Range of a column's finite numbers, and the episodes with others."""

    low: float = math.inf
    high: float = -math.inf
    bad: list[int] = dataclasses.field(default_factory=list)

    def add(self, episode: int, values: Any) -> None:
        """Takes the values of an episode."""
        import numpy as np

        values = np.asarray(values, np.float64)  # integers have no infinite start of a minimum
        is_finite = np.isfinite(values)
        if not is_finite.all():
            self.bad.append(episode)
        self.low = float(np.min(values, initial=self.low, where=is_finite))
        self.high = float(np.max(values, initial=self.high, where=is_finite))


def _said(column: base.Column, numbers: _Numbers | None) -> str:
    text = f"{column.dtype} {list(column.shape)}  {', '.join(column.names[:16])}"
    is_flag = not column.shape and column.dtype == "bool"
    if numbers is None or is_flag or numbers.low > numbers.high:
        return text
    return f"{text}  {numbers.low:.4g} to {numbers.high:.4g}"


def _odd(ranges: Mapping[str, _Numbers]) -> Iterator[str]:
    for name, numbers in ranges.items():
        if numbers.bad:
            first, *others = numbers.bad
            yield f"{name} is not finite in episode {first} and {len(others)} more"


def mapped(path: Path, map_name: str) -> tuple[list[Any], list[str]]:
    from starjax.addons.formats import recorded

    with base.open_dataset(path, base.detect(path)) as source:
        own = None if map_name else own_columns.mapping(source)
        file = ready.FOLDER if own else ready.find(map_name or ready.choose(source))
        columns = own or mapping.load(file)
        with progress.track("Inspect", len(source.lengths), unit="episodes") as advance:
            return recorded.recordings(source, columns, file.parent, advance)


def _format(form: base.Format) -> str:
    return form.description


def _mappings() -> Iterator[Row]:
    yield base.OURS, own_columns.ABOUT
    for name in ready.names():
        yield name, mapping.load(ready.find(name)).about


def tables() -> dict[str, Iterator[Row]]:
    """Returns the tables of formats and mappings."""
    return {
        "formats (export --format, import)": list_command.described(base.FORMATS, _format),
        "mappings (import --map)": _mappings(),
    }
