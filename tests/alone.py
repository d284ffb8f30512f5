"""A process with the packages of some extras alone, as in a new environment with them.

    python alone.py EXTRAS PROGRAM

An environment of its own would need the network; here every other installed package is hidden.
"""

import importlib.metadata
import re
import sys

from packaging.requirements import Requirement


def brought(requirements: list[str]) -> set[str]:
    """Distributions that requirements bring, with those that these need."""
    wanted, seen = list(map(Requirement, requirements)), set()
    while wanted:
        one = wanted.pop()
        extras = {"", *one.extras}
        name = canonical(one.name)
        if (name, *sorted(extras)) in seen:
            continue
        seen.add((name, *sorted(extras)))
        try:
            needed = importlib.metadata.requires(name) or []
        except importlib.metadata.PackageNotFoundError:
            continue  # files of another platform
        wanted += [
            need
            for need in map(Requirement, needed)
            if not need.marker or any(need.marker.evaluate({"extra": x}) for x in extras)
        ]
    return {name for name, *_ in seen}


def canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


class Hidden:
    """Finds no package of these names."""

    def __init__(self, names: set[str]) -> None:
        self.names = names

    def find_spec(self, name: str, path: object = None, target: object = None) -> None:
        if path is None and name in self.names:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


def hide(extras: str) -> None:
    """Hides every package that an environment of `starjax[extras]` lacks."""
    kept = brought([f"starjax[{extras}]" if extras else "starjax"])
    packages = importlib.metadata.packages_distributions().items()
    hidden = {name for name, dists in packages if not kept & set(map(canonical, dists))}
    for name in list(sys.modules):
        if name.split(".")[0] in hidden:
            del sys.modules[name]
    sys.meta_path.insert(0, Hidden(hidden))


if __name__ == "__main__":
    hide(sys.argv[1])
    exec(compile(sys.argv[2], "program", "exec"), {"__name__": "program"})
