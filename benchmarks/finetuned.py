"""Tables of fine-tunings, from results/finetune_*.json: success before and after, and branches."""

import json
from pathlib import Path
from typing import Any

from starjax.report import formats

RESULTS = Path(__file__).parent / "results"
COMMAND = "starjax finetune "


def ways(folder: Path = RESULTS) -> str:
    """Returns success before and after each complete fine-tuning as markdown."""
    header = ["Fine-tuning", "Best round", "Seen before", "Seen after", "Unseen before"]
    rows = [[*header, "Unseen after", "Minutes", "On"]]
    for found in (found for found in _results(folder) if "best" in found):
        before, best = found["before"], found["best"]
        after = found["after"] if best else before
        rows.append(
            [
                f"`{found['command'].removeprefix(COMMAND).partition(' --out')[0]}`",
                f"{best} of {len(found['rounds']) - 1}" if best else "none is better",
                *(_rate(x[part]) for part in ("seen", "unseen") for x in (before, after)),
                f"{_seconds(found) / 60:.0f}",
                formats.machine(found["hardware"]),
            ]
        )
    return formats.render(rows, names=1)


def branches(folder: Path = RESULTS) -> str:
    """Returns, for rounds with takeovers, the branches that the expert succeeded from."""
    told = [found for found in _results(folder) if "branches" in found["rounds"][-1]]
    names = list(told[0]["rounds"][-1]["branches"]) if told else []
    rows = [["Fine-tuning", "Round", *names, "From none"]]
    for found in told:
        for row in found["rounds"][1:]:
            left = sum(map(len, row["not_rescued"].values()))
            cells = [str(row["branches"][name]) for name in names]
            command = found["command"].removeprefix(COMMAND).partition(" --out")[0]
            rows.append([f"`{command}`", str(row["round"]), *cells, str(left)])
    return formats.render(rows, names=1) if told else "No result has branches yet."


def _results(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(path.read_text()) for path in sorted(folder.glob("finetune_*.json"))]


def _rate(found: dict[str, Any]) -> str:
    low, high = (100 * x for x in found["ci95"])
    count = f"{found['successes']}/{found['trials']}"
    return f"{count}: {100 * found['rate']:.1f}% ({low:.1f}-{high:.1f})"


def _seconds(found: dict[str, Any]) -> float:
    """Returns the time of all stages; compilation is a part of each."""
    return sum(s for name, s in found["timings_s"].items() if not name.endswith(": compile"))
