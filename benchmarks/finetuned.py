"""Tables of fine-tunings, from results/finetune_*.json: success, and branches."""

import json
import tomllib
from pathlib import Path
from typing import Any

import continued

from starjax.report import formats

HERE = Path(__file__).parent
RESULTS = HERE / "results"
COMMAND = "starjax finetune "
PARTS = ("seen", "unseen")
MISSING = "–"


def ways(folder: Path = RESULTS) -> str:
    """Returns success before and after every fine-tuning as markdown."""
    header = ["Task, policy", "Way", "Seen before", "Seen after", "Unseen before", "Unseen after"]
    rows = [[*header, "Rollouts", "Minutes"]]
    for found in finetunings(folder):
        cells = [_name(found), _way(found)]
        for part in PARTS:
            after = _rate(found["after"][part]) if found["best"] else MISSING
            cells += [_rate(found["before"][part]), after]
        rows.append([*cells, _rollouts(found), _minutes(found)])
    return formats.render(rows, names=2)


def finetunings(folder: Path = RESULTS) -> list[dict[str, Any]]:
    """Returns the complete fine-tunings by policy, continued ones joined, the best one first."""
    found = {x["file"]: x for x in complete(folder) if "task" in x}
    joined = continued.joined(found, _known()["continued"])
    return sorted(joined, key=lambda x: (_label(x), -sum(_after(x)[p]["rate"] for p in PARTS)))


def goal_of(found: dict[str, Any]) -> list[float]:
    """Returns the goal at seen and at unseen trocars in percent, of a policy or else its task."""
    known = _known()["goals"]
    return known.get(base(found)) or known.get(found["task"], known["others"])


def runs(folder: Path = RESULTS) -> str:
    """Returns the origin of every complete fine-tuning as markdown."""
    rows = [["Commit", "On", "Seed", "Command"]]
    for found in complete(folder):
        seed = str(found.get("seed", "0"))
        on = formats.machine(found["hardware"])
        rows.append([found["commit"][:10], on, seed, f"`{found['command']}`"])
    return formats.render(rows, names=4)


def branches(folder: Path = RESULTS) -> str:
    """Returns the takeovers that the expert finished, and the trials without one, by round."""
    told = [found for found in _results(folder) if "branches" in found["rounds"][-1]]
    told.sort(key=_name)
    names = list(told[0]["rounds"][-1]["branches"]) if told else []
    header = ["Fine-tuning", "Round", "Finished", *names, "From none", "Trocar-trial of these"]
    rows = [header]
    for found in told:
        for row in found["rounds"][1:]:
            finished = [
                f"{cause} {rate['successes']}/{rate['trials']}"
                for cause, rate in row["takeovers"].items()
            ]
            left = [
                f"{cause} {trocar}-{trial}"
                for cause, pairs in row["not_rescued"].items()
                for trocar, trial in pairs
            ]
            name = f"{_name(found)}, commit {found['commit'][:8]}"
            cells = [name, str(row["round"]), "; ".join(finished)]
            cells += [str(row["branches"][name]) for name in names]
            rows.append([*cells, str(len(left)), "; ".join(left) or MISSING])
    return formats.render(rows, names=1) if told else "No result has branches yet."


def complete(folder: Path = RESULTS) -> list[dict[str, Any]]:
    """Returns the results of fine-tunings that ended."""
    return [found for found in _results(folder) if "best" in found]


def learning_seconds(found: dict[str, Any]) -> list[float]:
    """Returns the seconds after which each round had its policy, from 0 for the policy itself.

    Validations and reports do not count; compilation, demonstrations and features do.
    """
    stages = {
        name: seconds
        for name, seconds in found["timings_s"].items()
        if not name.endswith(": compile") and not name.endswith("validation")
    }
    first = sum(s for name, s in stages.items() if name.startswith(("collect", "features")))
    total = [0.0]
    for row in found["rounds"][1:]:
        mine = [s for name, s in stages.items() if name.startswith(f"round {row['round']} ")]
        total.append((total[-1] or first) + sum(mine))
    return total


def base(found: dict[str, Any]) -> str:
    """Returns the name of the policy that a command fine-tunes."""
    words = found["command"].removeprefix(COMMAND).split()
    name = words[words.index("--policy") + 1] if "--policy" in words else words[0]
    return Path(name).with_suffix("").as_posix().removeprefix("runs/").removeprefix("carried/")


def _results(folder: Path) -> list[dict[str, Any]]:
    paths = sorted(folder.glob("finetune_*.json"))
    return [{"file": path.stem, **json.loads(path.read_text())} for path in paths]


def _known() -> dict[str, Any]:
    return tomllib.loads((HERE / "finetune_goals.toml").read_text())


def _label(found: dict[str, Any]) -> str:
    return f"{_name(found)} ({found['weights'][:8]})"


def _name(found: dict[str, Any]) -> str:
    return f"{found['task']}, {base(found)}"


def _way(found: dict[str, Any]) -> str:
    return found["by"] if found["best"] else f"{found['by']}: no round is better"


def _after(found: dict[str, Any]) -> dict[str, Any]:
    return found["after"] if found["best"] else found["before"]


def _rollouts(found: dict[str, Any]) -> str:
    """Counts starts, or episodes of all iterations of a policy gradient."""
    count = sum(
        row.get("trials", 0) + row.get("episodes", 0) * len(row.get("iterations", ()))
        for row in found["rounds"]
    )
    return f"{count:,}" if count else MISSING


def _minutes(found: dict[str, Any]) -> str:
    """Renders the time of all stages; compilation is a part of each."""
    seconds = (s for name, s in found["timings_s"].items() if not name.endswith(": compile"))
    return f"{sum(seconds) / 60:.0f}"


def _rate(found: dict[str, Any]) -> str:
    low, high = (100 * x for x in found["ci95"])
    count = f"{found['successes']}/{found['trials']}"
    return f"{count}: {100 * found['rate']:.1f}% ({low:.1f}-{high:.1f})"
