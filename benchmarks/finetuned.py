"""Tables of fine-tunings, from results/finetune_*.json: success, goals, and branches."""

import itertools
import json
import tomllib
from pathlib import Path
from typing import Any

from starjax.report import formats

HERE = Path(__file__).parent
RESULTS = HERE / "results"
COMMAND = "starjax finetune "
PARTS = ("seen", "unseen")


def goals(folder: Path = RESULTS) -> str:
    """Returns the goal of each policy, the way that came nearest, and the others, as markdown."""
    header = ["Task, policy", "Goal", "Way", "Seen before", "Seen after", "Unseen before"]
    header += ["Unseen after", "Goal met", "RCM p99 (mm)", "Rollouts", "Minutes", "Other ways"]
    rows = [header]
    found = sorted((x for x in complete(folder) if "task" in x), key=_policy)
    for (task, weights), results in itertools.groupby(found, key=_policy):
        # The first result of the most successes at all trocars.
        won, *others = sorted(results, key=lambda x: -sum(_after(x)[p]["rate"] for p in PARTS))
        goal = goal_of(won)
        after, rounds = _after(won), won["rounds"][1:]
        missed = [g - 100 * after[part]["rate"] for g, part in zip(goal, PARTS, strict=True)]
        left = [f"{by:.1f} {part}" for by, part in zip(missed, PARTS, strict=True) if by > 1e-9]
        rows.append(
            [
                f"{task}, {base(won)} ({weights[:8]})",
                " / ".join(f"{x:.0f}" for x in goal),
                won["by"] if won["best"] else f"{won['by']}: no round is better",
                *(_rate(x[part]) for part in PARTS for x in (won["before"], after)),
                "missed by " + ", ".join(left) if left else "yes",
                formats.millimetres(after["rcm_error_mm"]["executed"]["p99"]),
                f"{sum(row.get('trials', 0) for row in rounds):,}",
                f"{_seconds(won) / 60:.0f}",
                "; ".join(_brief(x) for x in others) or "–",
            ]
        )
    return formats.render(rows, names=1)


def goal_of(found: dict[str, Any]) -> list[float]:
    """Returns the goal at seen and at unseen trocars in percent, of a policy or else its task."""
    known = tomllib.loads((HERE / "finetune_goals.toml").read_text())["goals"]
    return known.get(base(found)) or known.get(found["task"], known["others"])


def runs(folder: Path = RESULTS) -> str:
    """Returns the origin of every complete fine-tuning as markdown."""
    rows = [["Command", "Seed", "Commit", "On"]]
    for found in complete(folder):
        seed = str(found.get("seed", "0"))
        on = formats.machine(found["hardware"])
        rows.append([f"`{found['command']}`", seed, found["commit"][:10], on])
    return formats.render(rows, names=1)


def branches(folder: Path = RESULTS) -> str:
    """Returns, for rounds with takeovers, what the expert finished, and the trials it could not."""
    told = [found for found in _results(folder) if "branches" in found["rounds"][-1]]
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
            cells = [f"`{_flags(found)}`", str(row["round"]), "; ".join(finished)]
            cells += [str(row["branches"][name]) for name in names]
            rows.append([*cells, str(len(left)), "; ".join(left) or "–"])
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
    return [json.loads(path.read_text()) for path in sorted(folder.glob("finetune_*.json"))]


def _policy(found: dict[str, Any]) -> tuple[str, str]:
    return found["task"], found["weights"]


def _after(found: dict[str, Any]) -> dict[str, Any]:
    return found["after"] if found["best"] else found["before"]


def _flags(found: dict[str, Any]) -> str:
    """Returns a command without its first words and its directory."""
    return found["command"].removeprefix(COMMAND).partition(" --out")[0]


def _brief(found: dict[str, Any]) -> str:
    after = _after(found)
    rates = " and ".join(f"{100 * after[part]['rate']:.1f}" for part in PARTS)
    return f"{found['by']} {rates}, {_seconds(found) / 60:.0f} min"


def _rate(found: dict[str, Any]) -> str:
    low, high = (100 * x for x in found["ci95"])
    count = f"{found['successes']}/{found['trials']}"
    return f"{count}: {100 * found['rate']:.1f}% ({low:.1f}-{high:.1f})"


def _seconds(found: dict[str, Any]) -> float:
    """Returns the time of all stages; compilation is a part of each."""
    return sum(s for name, s in found["timings_s"].items() if not name.endswith(": compile"))
