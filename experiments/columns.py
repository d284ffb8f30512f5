"""Columns of the tables of results, and paired tests."""

import functools
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from starjax.evaluation.result import Trial, read_sweep
from starjax.report import compare, formats, outcomes, results, stats
from starjax.sim import registries

HIGHEST = 8  # index of the unseen trocar above all seen ones
TURN_WIDTH = 11  # degrees of a needle's turn, of the label `turn` of needle drive along the dial
TURNS = range(84, 150, TURN_WIDTH)  # degrees, where its values begin


class Scored(NamedTuple):
    """A result with its sweep and held-out errors.

    Attributes:
      run: the result.
      swept: sweep of the same policy over other trocars, None without one.
      held_out: last errors on held-out demonstrations, empty without any.
    """

    run: results.Run
    swept: results.Run | None
    held_out: dict[str, float]


def read(file: Path, label: str) -> Scored:
    """Reads a result, its `.holdout.jsonl`, and the `sweep.json` next to a `result.json`."""
    run = results.load(file)._replace(label=label)
    swept, sweep = None, file.with_name("sweep.json")
    if file.name == "result.json" and sweep.is_file():
        (swept,) = results.swept([run._replace(sweep=read_sweep(sweep))])
    log = file.with_suffix(".holdout.jsonl")
    lines = log.read_text().splitlines() if log.is_file() else []
    return Scored(run, swept, json.loads(lines[-1]) if lines else {})


def paired(pairs: Sequence[Sequence[Scored]], part: str) -> formats.Table:
    """Draws McNemar's test of pairs of results on the same trials.

    Raises:
      ValueError: two results share no trials.
    """
    table = [["Method", "Against", "Trials", "Only the first", "Only the second", "p"]]
    for one, other in pairs:
        a, b = PARTS[part](one), PARTS[part](other)
        test = compare.pair(a, b)
        if test is None:
            raise ValueError(f"{a.label}, {b.label}: expected the same trials, got none")
        counts = [str(n) for n in (test.pairs, test.only_a, test.only_b)]
        table.append([a.label, b.label, *counts, formats.p_value(test.p)])
    return table


def rate(trials: Sequence[Trial], test: Callable[..., bool] = outcomes.strict) -> str:
    """Returns successes, trials and interval, such as `784/800: 98.0% (96.8–98.8)`."""
    if not trials:
        return "–"
    score = outcomes.tally(trials, test)
    return counted(score.successes, score.trials, (score.low, score.high))


def counted(successes: int, trials: int, interval: Sequence[float]) -> str:
    """Returns successes, trials and their interval."""
    low, high = (100 * x for x in interval)
    return f"{successes}/{trials}: {100 * successes / trials:.1f}% ({low:.1f}–{high:.1f})"


def _seen(scored: Scored) -> list[Trial]:
    return outcomes.split(scored.run.trials)[0]


def _unseen(scored: Scored) -> list[Trial]:
    return outcomes.split(scored.run.trials)[1]


def _gap(scored: Scored) -> str:
    seen, unseen = (outcomes.tally(trials) for trials in outcomes.split(scored.run.trials))
    middle, low, high = (100 * x for x in stats.gap(seen, unseen))
    return f"{middle:.1f} ({low:.1f} to {high:.1f})"


def _others(scored: Scored, low: float = 0.0, high: float = 1.0) -> str:
    trials = scored.swept.trials if scored.swept else []
    return rate([trial for trial in trials if low <= (trial.distance_m or 0.0) < high])


def _beyond(run: results.Run, distance_m: float) -> list[Trial]:
    return [trial for trial in run.trials if (trial.distance_m or 0.0) >= distance_m]


def _rcm(scored: Scored, kind: str, statistic: str) -> str:
    value = (scored.run.rcm_error_mm.get(kind) or {}).get(statistic)
    return "–" if value is None else f"{value:.1f}" if value >= 1 else formats.millimetres(value)


def _held_out(scored: Scored, name: str) -> str:
    return f"{scored.held_out[name]:.1f}" if name in scored.held_out else "–"


def _safe(scored: Scored) -> str:
    won = [trial for trial in scored.run.trials if outcomes.strict(trial)]
    return f"{sum(outcomes.safe(trial) for trial in won)} of {len(won)}"


def _time(scored: Scored) -> str:
    spent = scored.run.result.about.get("timings_s") or {}
    return formats.duration(sum(s for name, s in spent.items() if not name.endswith(": compile")))


def _stages(scored: Scored) -> str:
    """Counts failed trials by their last stage."""
    stages = registries.tasks.get(scored.run.result.scene.task).stages
    failed = [trial.stage for trial in scored.run.trials if not outcomes.strict(trial)]
    counted = ((name, failed.count(i)) for i, name in enumerate(stages))
    return ", ".join(f"{name} {count}" for name, count in counted if count)


def _running(scored: Scored) -> str:
    spent = scored.run.result.about.get("timings_s") or {}
    if "evaluate: compile" not in spent:
        return "–"
    return f"{spent['evaluate'] - spent['evaluate: compile']:.0f}"


def _swept(scored: Scored) -> results.Run:
    if scored.swept is None:
        raise ValueError(f"{scored.run.label}: expected a sweep, got none")
    return scored.swept


def _median(scored: Scored) -> str:
    steps = scored.run.result.figures["steps"]["median"]
    return "–" if steps is None else f"{steps / scored.run.result.control_hz:.1f}"


def _served(scored: Scored, draw: Callable[[dict[str, Any]], str]) -> str:
    """Draws a value of the clients' report, a dash for trials without a server."""
    report = scored.run.result.about.get("served")
    return draw(report) if report else "–"


def _fraction(part: str, whole: str) -> Callable[[Scored], str]:
    def draw(report: dict[str, Any]) -> str:
        percent = 100 * report[part] / max(report[whole], 1)
        return f"{report[part]} of {report[whole]}: {percent:.1f}%"

    return lambda scored: _served(scored, draw)


def _seeds(scored: Scored) -> str:
    trained = results.trained_seed(scored.run)
    return f"{'–' if trained is None else trained}, {scored.run.result.seed}"


def _code(scored: Scored) -> str:
    result = scored.run.result
    return formats.code(result.commit, result.dirty) or "–"


def by_turn(scored: Scored, part: str, k: int) -> stats.Rate:
    """Counts the successes in a sixth of the dial (0 to 5) at some of the trocars."""
    trials = {"seen": _seen, "unseen": _unseen, "trocars": lambda x: _swept(x).trials}[part](scored)
    return outcomes.tally([trial for trial in trials if trial.labels["turn"] == k])


def _by_turn(part: str, k: int, scored: Scored) -> str:
    found = by_turn(scored, part, k)
    low, middle, high = (100 * x for x in (found.low, found.rate, found.high))
    return f"{found.successes}/{found.trials}: {middle:.0f}% ({low:.0f}–{high:.0f})"


COLUMNS: dict[str, tuple[str, Callable[[Scored], str]]] = {
    "task": ("task", lambda x: x.run.result.scene.task.replace("_", " ")),
    "seen": ("seen", lambda x: rate(_seen(x))),
    "unseen": ("unseen", lambda x: rate(_unseen(x))),
    "all": ("all", lambda x: rate(x.run.trials)),
    "loose": ("all, loose", lambda x: rate(x.run.trials, outcomes.loose)),
    "safe": ("successes within 2 mm of the trocar", _safe),
    "gap": ("gap (percentage points)", _gap),
    "highest": ("highest trocar", lambda x: rate([t for t in _unseen(x) if t.trocar == HIGHEST])),
    "trocars": ("other trocars", _others),
    "near": ("within 10 mm", lambda x: _others(x, 0.0, 0.01)),
    "middle": ("10 to 20 mm", lambda x: _others(x, 0.01, 0.02)),
    "far": ("farther", lambda x: _others(x, 0.02)),
    "rcm_mean": ("RCM error, mean (mm)", lambda x: _rcm(x, "executed", "mean")),
    "rcm": ("RCM error, p99 (mm)", lambda x: _rcm(x, "executed", "p99")),
    "rcm_won": ("of successes", lambda x: _rcm(x, "executed", "p99_of_successes")),
    "rcm_within": ("within steps", lambda x: _rcm(x, "within_steps", "p99")),
    "rcm_commanded": ("commanded, maximum", lambda x: _rcm(x, "commanded", "max")),
    "tip": ("held-out tip (mm)", lambda x: _held_out(x, "position_error_mm")),
    "roll": ("held-out roll (deg)", lambda x: _held_out(x, "roll_error_deg")),
    "decision": ("inference (ms)", lambda x: f"{x.run.result.about['inference_ms']['p50']:.1f}"),
    "time": ("all stages", _time),
    "running": ("trials, after compiling (s)", _running),
    "late": ("plans late", _fraction("missed", "plans")),
    "held": ("steps held", _fraction("held", "steps")),
    "limited": ("steps limited", _fraction("limited", "steps")),
    "lost": ("requests lost", lambda x: _served(x, lambda report: str(report["lost"]))),
    "step": (
        "largest step (mm, rad)",
        lambda x: _served(x, lambda report: f"{report['move_mm']:.2f}, {report['turn_rad']:.3f}"),
    ),
    "off": (
        "commanded RCM error, maximum (mm)",
        lambda x: _served(x, lambda report: f"{report['rcm_commanded_mm']:.0e}"),
    ),
    "median": ("median success (s)", _median),
    "seeds": ("seeds: training, trials", _seeds),
    "stages": ("failures by their last stage", _stages),
    "code": ("code", _code),
    **{
        f"{part}_turn{k}": (f"{low}° to {low + TURN_WIDTH}°", functools.partial(_by_turn, part, k))
        for part in ("seen", "unseen", "trocars")
        for k, low in enumerate(TURNS)
    },
}


def _with_trials(run: results.Run, trials: Sequence[Trial]) -> results.Run:
    """Replaces the trials of a run."""
    return run._replace(result=run.result._replace(trials=tuple(trials)))


PARTS: dict[str, Callable[[Scored], Any]] = {
    "twelve": lambda x: x.run,
    "seen": lambda x: _with_trials(x.run, _seen(x)),
    "unseen": lambda x: _with_trials(x.run, _unseen(x)),
    "trocars": _swept,
    "far": lambda x: _with_trials(_swept(x), [t for t in _swept(x).trials if t.distance_m >= 0.02]),
}
