"""Tables of benchmarks, from results/: the newest figure of each, the learners, the experts."""

import json
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from starjax.report import formats
from starjax.report import stress as broken

HERE = Path(__file__).parent
MONITORED = ("compact", "needle_pick", "peg_transfer_bimanual")
_VALUE = re.compile(r"\{([^:{}]+):?([^{}]*)\}")


def table() -> str:
    """The table of speed as markdown.

    Raises:
      KeyError: a row names a value that its results do not have.
    """
    rows = [["Work", "Here", "Peer, same run", "Floor", "On"]]
    for said in tomllib.loads((HERE / "newest.toml").read_text())["rows"]:
        found = _results(said["file"])
        cells = [_filled(said.get(cell, ""), found) for cell in ("here", "peer", "floor")]
        rows.append([said["work"], *cells, formats.machine(found["hardware"])])
    return formats.render(rows, names=len(rows[0]))


def other(name: str) -> str:
    """The table of `<name>.toml`, with a header and cells of its own; KeyError as `table`."""
    said = tomllib.loads((HERE / f"{name}.toml").read_text())
    rows = [[_filled(cell, _results(row["file"])) for cell in row["cells"]] for row in said["rows"]]
    return formats.render([said["header"], *rows], names=1)


def stress(name: str) -> str:
    """What breaks a policy, of results/<name>_gpu.json."""
    return formats.render(broken.table(_results(f"{name}_gpu")), names=2)


def monitor(name: str) -> str:
    """Returns the alarms of a packaged policy's monitor, of results/<name>_gpu.json."""
    found = _results(f"{name}_gpu")
    header = ["Disturbance", "Success", "Failures announced before the clock", "Median time"]
    header += ["False alarms on successes", "Success without alarm"]
    body = [[label, *_alarm_cells(row)] for label, row in found["rows"].items()]
    more: dict[str, Callable[[dict[str, Any]], str]] = {}
    if all("clock_false_alarms" in row for row in found["rows"].values()):
        more["False alarms of the clock"] = lambda row: _percent(row["clock_false_alarms"])
    if any(row["before_drop"]["trials"] for row in found["rows"].values()):
        more["Announced, of failures not let go"] = lambda row: _counted(row["others_before_clock"])
        more["Drops announced before the fall"] = lambda row: _counted(row["before_drop"])
    if found["monitor"]["alpha"] > found["strict"]["alpha"]:
        name = f"At {100 * found['strict']['alpha']:.0f}%: announced, false alarms"
        more[name] = lambda row: ", ".join(map(_percent, row["at_strict"].values()))
    header += more
    for cells, row in zip(body, found["rows"].values(), strict=True):
        cells += [draw(row) for draw in more.values()]
    return formats.render([header, *body], names=1)


def monitor_attempts() -> str:
    """Returns the goals that each way to make a monitor meets, of results/monitor_<policy>_gpu."""
    found = {policy: _results(f"monitor_{policy}_gpu").get("attempts") for policy in MONITORED}
    tried = {policy: attempts for policy, attempts in found.items() if attempts}
    names = dict.fromkeys(name for attempts in tried.values() for name in attempts)
    body = [[name, *(_attempt(tried[policy][name]) for policy in tried)] for name in names]
    return formats.render([["Monitor", *(f"`{policy}`" for policy in tried)], *body], names=1)


def _attempt(found: dict[str, Any]) -> str:
    met = found["tested"]
    how = f"{100 * found['alpha']:.0f}%, {found['still_s']:.1f} s"
    return f"{how}: {met['early']}, {met['false']}, {met['both']} of {met['pairs']}"


def _alarm_cells(row: dict[str, Any]) -> list[str]:
    alarms = row["alarms"]
    median = "\u2013" if alarms["median_s"] is None else f"{alarms['median_s']:.1f} s"
    rates = [row["strict"], alarms["before_clock"], alarms["false_alarms"], alarms["silent"]]
    success, early, false, silent = map(_counted, rates)
    return [success, early, median, false, silent]


def _percent(rate: dict[str, Any]) -> str:
    return f"{100 * rate['rate']:.0f}%" if rate["trials"] else "\u2013"


def _counted(rate: dict[str, Any]) -> str:
    if not rate["trials"]:
        return "\u2013"
    return f"{rate['successes']:,}/{rate['trials']:,} = {100 * rate['rate']:.0f}%"


def _results(file: str) -> dict[str, Any]:
    return json.loads((HERE / "results" / f"{file}.json").read_text())


def _filled(text: str, results: dict[str, Any]) -> str:
    """A template with its values in place."""

    def value(match: re.Match[str]) -> str:
        found: Any = results
        for key in match[1].split("/"):
            found = found[int(key) if isinstance(found, list) else key]
        return f"{found / 1e6:#.3g}" if match[2] == "M" else format(found, match[2])

    return _VALUE.sub(value, text)
