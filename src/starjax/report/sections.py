"""Facts, headline numbers and tables of the page, without those that a run lacks."""

import shlex
import statistics
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from starjax.report import (
    compare,
    formats,
    notes,
    outcomes,
    results,
    stats,
    tables,
)
from starjax.report.formats import Table

TitledTable = tuple[str, Table, str]  # heading, table, note


class Card(NamedTuple):
    """A headline number.

    Attributes:
      name: its name.
      value: the number as text.
      unit: its unit.
      more: fine print.
      rate: the rate of a success, or None.
      part: `seen` or `unseen` of a rate.
    """

    name: str
    value: str
    unit: str
    more: str
    rate: stats.Rate | None = None
    part: str = ""


def facts(runs: Sequence[results.Run]) -> dict[str, str]:
    """Returns settings and machines of the runs, each once."""
    trained = [results.trained_seed(run) for run in runs]
    scored = [run.result.seed for run in runs]
    items = {
        "Observation": [compare.observed(runs)],
        "Trials" if len(runs) == 1 else "Trials per run": [_trials(run) for run in runs],
        "Robot": [robot(run.result.scene.arms, run.result.scene.tools) for run in runs],
        "Preset": [run.result.config.get("preset") for run in runs],
        "Seed": trained,
        "Seed of the trials": [] if scored == trained else scored,
        "Code": [formats.code(run.result.commit, run.result.dirty) for run in runs],
        "Hardware": [formats.hardware(run.result.about.get("hardware") or {}) for run in runs],
    }
    texts = {
        name: "; ".join(dict.fromkeys(str(value) for value in values if value not in (None, "")))
        for name, values in items.items()
    }
    return {name: text for name, text in texts.items() if text}


def robot(arms: Sequence[str], tools: Sequence[str]) -> str:
    """Returns the robots' names, e.g. `fr5 with grasper`."""
    return " and ".join(f"{arm} with {tool}" for arm, tool in zip(arms, tools, strict=True))


def _trials(run: results.Run) -> str:
    trocars = len(outcomes.by_trocar(run.trials))
    return f"{len(run.trials)} over {trocars} trocars" if trocars else ""


def cards(run: results.Run) -> Iterator[Card]:
    """Yields the headline numbers that a run has."""
    seen, unseen = outcomes.rates(run.trials)
    for part, rate in (("seen", seen), ("unseen", unseen)):
        if rate:
            more = f"{rate.successes} of {rate.trials}, {formats.interval(rate)}"
            yield Card(f"Success, {part} trocars", f"{100 * rate.rate:.0f}", "%", more, rate, part)
    if seen and unseen:
        middle, low, high = (100 * x for x in stats.gap(seen, unseen))
        more = f"seen minus unseen, 95% interval {low:+.0f} to {high:+.0f}"
        yield Card("Generalization gap", f"{middle:+.0f}", " points", more)
    executed = run.rcm_error_mm.get("executed") or {}
    if executed.get("p99") is not None:
        worst = formats.millimetres(executed["max"])
        more = f"99th percentile; {worst} mm at worst, both at the ends of control steps"
        yield Card("Shaft off the trocar", formats.millimetres(executed["p99"]), " mm", more)
    if seconds := outcomes.times(run.trials, run.result.control_hz):
        more = f"median of {len(seconds)} successes"
        yield Card("Time of a success", f"{statistics.median(seconds):.1f}", " s", more)
    if ms := run.result.about.get("inference_ms"):
        more = f"median; 99th percentile {ms['p99']:.1f} ms"
        yield Card("One policy call", f"{ms['p50']:.1f}", " ms", more)


def failed(run: results.Run) -> Table:
    """Makes a row per failed trial with the command that shows it again; empty if none can."""
    source = _source(run)
    trials = [trial for trial in run.trials if not outcomes.strict(trial)] if source else []
    rows = [
        [
            str(trial.trocar),
            str(trial.trial),
            outcomes.SHORT[outcomes.failure(trial)],
            f"{trial.steps / run.result.control_hz:.1f}",
            f"{source} --seed {trial.seed} --trocar {trial.trocar} --trial {trial.trial}",
        ]
        for trial in trials
    ]
    return [["Trocar", "Trial", "Cause", "After (s)", "Command"], *rows] if rows else []


def _source(run: results.Run) -> str:
    """Returns the begin of `starjax view` with the policy of a run, empty if it is unknown."""
    try:
        words = shlex.split(run.result.about.get("command") or "")
    except ValueError:  # from an edited file
        return ""
    arm = [f"--arm {shlex.quote(words[i + 1])}" for i in _flags(words, "--arm")]
    if (run.path / "config.json").is_file():
        return " ".join([f"starjax view --run {shlex.quote(str(run.path))}", *arm])
    policies = [words[i + 1] for i in _flags(words, "--policy") if "://" not in words[i + 1]]
    return " ".join(
        [f"starjax view --policy {shlex.quote(p)}" for p in policies[:1]] + arm * bool(policies)
    )


def _flags(words: Sequence[str], flag: str) -> list[int]:
    """Returns the places of a flag that a value follows."""
    return [i for i, word in enumerate(words[:-1]) if word == flag]


def comparisons(runs: Sequence[results.Run], against: str = "") -> list[TitledTable]:
    """Returns paired tests, as `tables.paired`, and success by three tests of several runs."""
    by_test_note = notes.by_test(compare.task_text(runs))
    return _titled(
        (tables.paired_title(runs, against), tables.paired(runs, against), notes.PAIRED),
        ("Success by three tests (%)", tables.by_test(runs, formats.brief), by_test_note),
    )


def swept(runs: Sequence[results.Run], against: str = "") -> list[TitledTable]:
    """Returns success through the trocars of sweeps, and its paired tests."""
    title = f"{tables.paired_title(runs, against)} {tables.SWEPT_PAIRED}"
    return _titled(
        (tables.SWEPT, tables.swept(runs, formats.brief), notes.SWEPT),
        (title, tables.paired(results.swept(runs), against), notes.PAIRED),
    )


def measurements(runs: Sequence[results.Run]) -> list[TitledTable]:
    """Returns failures of several runs, RCM error, inference time (Table IV) and phases' times."""
    return _titled(
        ("Failed trials", tables.failures(runs) if len(runs) > 1 else [], notes.FAILURES),
        ("RCM error (mm)", tables.rcm(runs), notes.RCM),
        ("Inference time", tables.inference(runs), notes.inference(runs)),
        ("Where the time went", tables.phases(runs), notes.PHASES),
    )


def flat(config: Mapping[str, Any], prefix: str = "") -> list[str]:
    """Returns settings as lines `name.name = value`."""
    lines = []
    for name, value in config.items():
        if isinstance(value, Mapping):
            lines += flat(value, f"{prefix}{name}.")
        else:
            lines.append(f"{prefix}{name} = {formats.listing(value)}")
    return lines


def _titled(*parts: TitledTable) -> list[TitledTable]:
    """Drops tables without rows."""
    return [part for part in parts if len(part[1]) > 1]
