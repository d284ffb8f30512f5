"""Episodes of a dataset that are imported, with their splits and texts."""

from starjax.addons.formats.base import Source
from starjax.addons.formats.mapping import Map
from starjax.core import errors

FAILURES = ("failure", "fail")  # splits of episodes that no policy is to learn from
_WHOLE = {"train"}  # the splits of a dataset that is not split


def chosen(source: Source, mapping: Map) -> list[int]:
    """Returns the episodes that are imported, in their order.

    Raises:
      errors.UsageError: `skip` or `splits` has a number or name that the dataset lacks.
    """
    count = len(source.lengths)
    for episode in mapping.skip:
        if episode >= count:
            raise errors.UsageError("skip", f"episodes from 0 to {count - 1}", episode)
    for name in mapping.splits:
        errors.choice("splits", name, source.splits or ["none: the files are not split"])
    wanted = set(range(count))
    if mapping.splits:
        wanted = {i for name in mapping.splits for i in source.splits[name]}
    return sorted(wanted.intersection(range(count)) - set(mapping.skip))


def splits_of(source: Source, episode: int) -> list[str]:
    """Returns the names of an episode's splits; empty if the dataset is not split."""
    if set(source.splits) <= _WHOLE:
        return []
    return [name for name, episodes in source.splits.items() if episode in episodes]


def is_failure(source: Source, episode: int) -> bool:
    """Returns True if an episode is in a split of failures."""
    return any(name in FAILURES for name in splits_of(source, episode))


def texts(source: Source, numbers: list[int]) -> dict[str, dict[str, int]]:
    """Counts the episodes of each text by column: instructions, tools, tasks."""
    counts: dict[str, dict[str, int]] = {}
    for episode in numbers:
        for column, found in source.texts(episode).items():
            for text in found:
                of_column = counts.setdefault(column, {})
                of_column[text] = of_column.get(text, 0) + 1
    return counts
