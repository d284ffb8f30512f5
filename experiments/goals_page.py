"""Goals of robust policies against figures, as tables of goals/README.md.

goals/goals.toml lists them. A figure is `[file, key, ...]`: a rate in a result, its path from the
repository's root and the keys that lead to it.
"""

import json
import tomllib
from pathlib import Path
from typing import Any

import goals_list

from starjax.report import formats

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
POLICIES = ("compact", "needle_pick", "peg_transfer_bimanual")
# Goals: failures announced before the clock, false alarms under a disturbance and without one.
EARLY, FALSE, ALPHA = 0.9, 0.1, 0.05
# Stress of further policies, on the trials of the goals.
LOOK = "benchmarks/results/stress_look_gpu.json"
INHERITED = "benchmarks/results/stress_inherited_gpu.json"
# Policies that can drop something, and the goal: what falls is announced before.
DROPPING, BEFORE = ("peg_transfer_bimanual", "needle_handover"), 0.5
_NONE = {"trials": 0, "rate": None}


def stress() -> str:
    """Returns success of the earlier and the robust policy on the same trials."""
    rows = [["Disturbance", "`compact`", "`peg_transfer_robust`", "Goal (%)", "Met"]]
    for row in _goals()["stress"]:
        old, new = (_figure(row[name]) for name in ("old", "new"))
        assert old["trials"] == new["trials"]
        rows.append([row["name"], _rate(old), _rate(new), f"{row['goal']}", _met(new, row["goal"])])
    return formats.render(rows, names=1)


def others() -> str:
    """Returns the goals that are single figures."""
    rows = [["Goal", "Wanted (%)", "Measured", "Met"]]
    for row in _goals()["others"]:
        found = _figure(row["figure"])
        rows.append([row["name"], f"{row['goal']}", _rate(found), _met(found, row["goal"])])
    return formats.render(rows, names=1)


def beside(file: str, label: str) -> str:
    """Returns success of both policies and of a third, whose stress may lack some levels."""
    rows, third = [["Disturbance", "`compact`", "`peg_transfer_robust`", label]], _read(file)
    for row in _goals()["stress"]:
        found = third
        for key in row["old"][1:]:
            found = found.get(key, {})
        if found:
            rates = (_figure(row["old"]), _figure(row["new"]), found)
            rows.append([row["name"], *map(_rate, rates)])
    return formats.render(rows, names=1)


def monitor() -> str:
    """Returns, by disturbance and policy, failures announced before the clock and false alarms."""
    found = [_read(f"benchmarks/results/monitor_{policy}_gpu.json")["rows"] for policy in POLICIES]
    rows = [["Disturbance"]]
    for policy in POLICIES:
        rows[0] += [f"`{policy}`: announced", "false alarms"]
    for label in dict.fromkeys(label for table in found for label in table):
        most = ALPHA if label.startswith("nothing") else FALSE
        cells = []
        for table in found:
            missing = ["\u2013", "\u2013"]
            cells += _alarms(table[label]["alarms"], most) if label in table else missing
        rows.append([label, *cells])
    rows.append(
        ["goals met under a disturbance", *(cell for table in found for cell in _pairs(table))]
    )
    return formats.render(rows, names=1)


def drops() -> str:
    """Returns, by disturbance and policy, what was dropped and announced before it fell."""
    found = [_read(f"benchmarks/results/monitor_{policy}_gpu.json")["rows"] for policy in DROPPING]
    rows = [["Disturbance", *(f"`{policy}`" for policy in DROPPING)]]
    for label in dict.fromkeys(label for table in found for label in table):
        cells = [table[label]["before_drop"] if label in table else _NONE for table in found]
        rows.append([label, *(_counted(rate, (rate["rate"] or 0.0) >= BEFORE) for rate in cells)])
    return formats.render(rows, names=1)


def runs() -> str:
    """Returns the origin of every file of the tables above."""
    goals = _goals()
    files = [row[name][0] for row in goals["stress"] for name in ("old", "new")]
    files += [row["figure"][0] for row in goals["others"]]
    files.append("benchmarks/results/handover_fresh_gpu.json")
    files += [f"benchmarks/results/monitor_{policy}_gpu.json" for policy in (*POLICIES, *DROPPING)]
    rows = [["Result", "Command", "Seed", "Commit", "On"]]
    rows += [goals_list.origin(file) for file in dict.fromkeys([*files, *goals_list.files()])]
    return formats.render(rows, names=len(rows[0]))


TABLES = {
    "goals_stress": stress,
    "goals_others": others,
    "goals_look": lambda: beside(LOOK, "trained with `look` too"),
    "goals_inherited": lambda: beside(INHERITED, "preset `gpu` on its encoder"),
    "goals_monitor": monitor,
    "goals_drops": drops,
    "goals_runs": runs,
}


def _goals() -> dict[str, Any]:
    return tomllib.loads((HERE / "goals" / "goals.toml").read_text())


def _read(file: str) -> dict[str, Any]:
    return json.loads((ROOT / file).read_text())


def _figure(path: list[str]) -> dict[str, Any]:
    found = _read(path[0])
    for key in path[1:]:
        found = found[key]
    return found


def _rate(found: dict[str, Any]) -> str:
    low, high = (100 * bound for bound in found["ci95"])
    count = f"{found['successes']:,}/{found['trials']:,}"
    return f"{count}: {100 * found['rate']:.1f}% ({low:.1f}-{high:.1f})"


def _met(found: dict[str, Any], goal: float) -> str:
    missed = goal - 100 * found["rate"]
    return f"missed by {missed:.1f}" if missed > 1e-9 else "yes"


def _alarms(found: dict[str, Any], most: float) -> list[str]:
    """Renders both rates; `most` is the goal of false alarms."""
    early, false = found["before_clock"], found["false_alarms"]
    is_early = (early["rate"] or 0.0) >= EARLY
    return [_counted(early, is_early), _counted(false, (false["rate"] or 0.0) <= most)]


def _pairs(table: dict[str, Any]) -> list[str]:
    """Counts the disturbances under which a policy meets each goal, and both."""
    found = [row["alarms"] for label, row in table.items() if not label.startswith("nothing")]
    early = [(row["before_clock"]["rate"] or 0.0) >= EARLY for row in found]
    false = [row["false_alarms"] for row in found]
    quiet = [bool(rate["trials"]) and rate["rate"] <= FALSE for rate in false]
    both = sum(map(all, zip(early, quiet, strict=True)))
    return [f"{sum(early)} of {len(found)}", f"{sum(quiet)} of {len(found)}, both {both}"]


def _counted(rate: dict[str, Any], is_met: bool) -> str:
    """Renders a rate, bold where its goal is met."""
    if not rate["trials"]:
        return "\u2013"
    text = f"{rate['successes']:,}/{rate['trials']:,} = {100 * rate['rate']:.0f}%"
    return f"**{text}**" if is_met else text
