"""The paper's tables as markdown: success (III), paired tests, RCM error, inference time (IV)."""

import itertools
from collections.abc import Callable, Sequence

from starjax import methods
from starjax.evaluation import sweep
from starjax.report import captions, outcomes, results, stats

Table = list[list[str]]  # header first
# Test of success -> (function of a trial, meaning).
TESTS: dict[str, tuple[Callable[[outcomes.Trial], bool], str]] = {
    "strict": (outcomes.strict, "on the target peg, released, at rest, in time"),
    "loose": (outcomes.loose, "SurRoL's test: the block was near its place on the target peg"),
    "safe": (outcomes.safe, "strict, and the executed RCM error never passed 2 mm"),
}


def markdown(runs: Sequence[results.Run]) -> str:
    """tables.md: every table that the runs have numbers for, each with a line on how to read it."""
    parts = [
        ("Table III. Task success on peg transfer (%)", success(runs), SUCCESS_NOTE),
        ("Success by three tests (%)", by_test(runs), TESTS_NOTE),
        ("Paired comparison with STAR-Diff", paired(runs), PAIRED_NOTE),
        (SWEPT, swept(runs), f"{SWEPT_NOTE} {_CELL_NOTE}"),
        (SWEPT_PAIRED, paired(results.swept(runs)), PAIRED_NOTE),
        ("Failed trials", failures(runs), FAILURES_NOTE),
        ("RCM error (mm)", rcm(runs), RCM_NOTE),
        ("Table IV. Inference time", inference(runs), inference_note(runs)),
    ]
    filled = [f"## {title}\n\n{render(t)}\n\n{note}\n" for title, t, note in parts if len(t) > 1]
    notes = "".join(f"- {text}\n" for text in captions.notes(runs))
    head = f"# Peg transfer from {results.observed(runs)} observations\n"
    return "\n".join(part for part in (head, notes, *filled) if part)


_CELL_NOTE = "Successes/trials and the 95% Wilson interval in brackets."
SUCCESS_NOTE = (
    f"{_CELL_NOTE[:-1]}; the gap is seen minus unseen in percentage points with Newcombe's 95% "
    "interval, and means little where both are low."
)
TESTS_NOTE = ". ".join(f"{name.capitalize()}: {what}" for name, (_, what) in TESTS.items()) + "."
PAIRED_NOTE = (
    "McNemar's exact test on trials with the same trocar and seed; Holm corrects for the number "
    "of comparisons."
)
SWEPT = "Success through other trocars (%)"
SWEPT_NOTE = (
    "Trials of the sweep, all of them and by the distance of their trocar to the nearest one in "
    "the demonstrations."
)
SWEPT_PAIRED = "Paired comparison with STAR-Diff through these trocars"
FAILURES_NOTE = "Each failed trial is counted under the first class that applies."
RCM_NOTE = (
    "Distance of the shaft's axis from the trocar. Commanded: as the policy asked for it. "
    "Executed: as the simulated arm did it, at the ends of all control steps of all trials or of "
    "the successful ones; a trial that fails has up to ten times as many steps. Within steps: the "
    "largest at any physics step of each control step, where the servos have not answered yet."
)
PHASES_NOTE = (
    "Wall-clock time, summed over every start. Methods share the demonstrations, and some weights "
    "and trials."
)
_QUANTILES = ("p50", "p95", "p99")
_COMPILE = ": compile"  # ends the name of a phase's share spent compiling
INFERENCE_NOTE = (
    "One decision for one environment: observation in, commands out; compiling is not counted. "
    "One DDIM step is a time only: its plan is the noise that it began with."
)


def rate(score: stats.Rate) -> str:
    """E.g. `74.0 (71/96) [64.4, 81.7]`."""
    percent = [100 * x for x in (score.rate, score.low, score.high)]
    counts = f"{score.successes}/{score.trials}"
    return f"{percent[0]:.1f} ({counts}) [{percent[1]:.1f}, {percent[2]:.1f}]"


def success(runs: Sequence[results.Run]) -> Table:
    """Table III."""
    table = [["Group", "Method", "Seen ↑", "Unseen ↑", "Gap ↓"]]
    scores = [(run, _seen_unseen(run, outcomes.strict)) for run in runs if run.trials]
    best = [max((s.rate for _, pair in scores if (s := pair[i])), default=0.0) for i in (0, 1)]
    for run, (seen, unseen) in scores:
        cells = [rate(score) if score else "–" for score in (seen, unseen)]
        for part, score in enumerate((seen, unseen)):
            if len(scores) > 1 and score and score.rate == best[part]:
                cells[part] = f"**{cells[part]}**"
        cells.append(points(stats.gap(seen, unseen)) if seen and unseen else "–")
        table.append([run.group, run.label, *cells])
    return table


def by_test(runs: Sequence[results.Run], cell: Callable[[stats.Rate], str] = rate) -> Table:
    """Strict, loose and safe success, seen and unseen."""
    header = [f"{name.capitalize()}, {part}" for name in TESTS for part in ("seen", "unseen")]
    table = [["Method", *header]]
    for run in runs:
        if run.trials:
            scores = [s for test, _ in TESTS.values() for s in _seen_unseen(run, test)]
            table.append([run.label, *(cell(s) if s else "–" for s in scores)])
    return table


def swept(runs: Sequence[results.Run], cell: Callable[[stats.Rate], str] = rate) -> Table:
    """Success of the sweeps' trials: all, safe, and strict by distance to training's trocars."""
    runs = results.swept(runs)
    bins = sorted({_bin(trial) for run in runs for trial in run.trials})
    width = 1e3 * sweep.BIN_WIDTH
    spans = (f"{width * b:g} to {width * (b + 1):g} mm" for b in bins)
    table = [["Method", "Strict", "Safe", *spans]]
    for run in runs:
        scores = [outcomes.tally(run.trials, test) for test in (outcomes.strict, outcomes.safe)]
        parts = ([t for t in run.trials if _bin(t) == b] for b in bins)
        cells = [cell(score) for score in scores]
        cells += [cell(outcomes.tally(part)) if part else "–" for part in parts]
        table.append([run.label, *cells])
    return table


def failures(runs: Sequence[results.Run]) -> Table:
    """Failed trials by class, classes that never occurred left out."""
    counts = [(run.label, outcomes.failures(run.trials)) for run in runs if run.trials]
    classes = [key for key in outcomes.FAILURES if any(key in found for _, found in counts)]
    table = [["Method", *(outcomes.SHORT[key].capitalize() for key in classes)]]
    if classes:
        table += [[label, *(str(found.get(k, 0)) for k in classes)] for label, found in counts]
    return table


def paired(runs: Sequence[results.Run]) -> Table:
    """McNemar's test of every run of STAR-Diff against each run that met the same trials."""
    table = [["Against", "Pairs", "Only STAR-Diff", "Only the other", "p", "p (Holm)"]]
    ours = [run for run in runs if run.result["method"] == results.OURS]
    others = [run for run in runs if run.result["method"] != results.OURS]
    pairs = [*itertools.product(ours, others), *itertools.combinations(ours, 2)]
    found = [(a, b, test) for a, b in pairs if (test := results.pair(a, b))]
    # Methods that are one policy, as DP-RCM-4 and STAR-Diff-Single, are one comparison.
    single = {_comparison(a, b, test): test.p for a, b, test in found}
    corrected = dict(zip(single, stats.holm(list(single.values())), strict=True))
    for a, b, test in found:
        p = corrected[_comparison(a, b, test)]
        counts = [str(n) for n in (test.pairs, test.only_a, test.only_b)]
        against = b.label if len(ours) == 1 else f"{b.label}, of {a.label}"
        table.append([against, *counts, p_value(test.p), p_value(p)])
    return table


def rcm(runs: Sequence[results.Run]) -> Table:
    """Commanded and executed RCM error, at the ends of control steps and within them."""
    keys = [("commanded", "max")]
    keys += [("executed", what) for what in ("mean", "p99_of_successes", "p99", "max")]
    keys += [("within_steps", what) for what in ("p99", "max")]
    names = (f"{kind.capitalize()} {what}".replace("_", " ") for kind, what in keys)
    table = [["Method", *names]]
    for run in runs:
        errors = run.result.get("rcm_error_mm") or {}
        values = [(errors.get(kind) or {}).get(what) for kind, what in keys]
        if any(v is not None for v in values):
            table.append([run.label, *("–" if v is None else millimetres(v) for v in values)])
    return table


def inference(runs: Sequence[results.Run]) -> Table:
    """Table IV: latency in ms and the rate it allows, a row per method and number of DDIM steps."""
    table = [["Method", "DDIM steps", "p50 (ms)", "p95 (ms)", "p99 (ms)", "p50 (Hz)", "p99 (Hz)"]]
    for run in runs:
        rows = [(run.label, str(steps), ms) for steps, ms in results.latencies(run)]
        if roll := (run.bench or run.result).get("roll_network_ms"):
            rows.append((f"{run.label}, roll network alone", "–", roll))
        for name, steps, ms in rows:
            times = [f"{ms[q]:.3f}" if ms["p50"] < 1 else f"{ms[q]:.1f}" for q in _QUANTILES]
            hertz = [f"{1e3 / ms[q]:.0f}" for q in ("p50", "p99")]
            table.append([name, steps, *times, *hertz])
    return table


def inference_note(runs: Sequence[results.Run]) -> str:
    """How to read Table IV, and where `starjax bench` ran if not on the machine of the run."""
    note = INFERENCE_NOTE
    for run in runs:
        timed, scored = (
            captions.hardware(x.get("hardware") or {}) for x in (run.bench, run.result)
        )
        if timed and timed != scored:
            rows = ", ".join(sorted(run.bench["inference_ms_by_ddim_steps"], key=int))
            note += f" {run.label}'s rows of {rows} steps are of {timed}."
    return note


def phases(runs: Sequence[results.Run]) -> Table:
    """Wall-clock time of the phases that each result rests on."""
    times = [(run.label, run.result.get("timings_s") or {}) for run in runs]
    every = dict.fromkeys(name for _, found in times for name in found)
    names = [name for name in every if not name.endswith(_COMPILE)]
    table = [["Method", *(name.capitalize() for name in names), "Total", "Of it compiling"]]
    for label, found in times:
        if any(name in found for name in names):
            sums = [sum(found.get(n + end, 0.0) for n in names) for end in ("", _COMPILE)]
            cells = [captions.duration(found[n]) if n in found else "–" for n in names]
            table.append([label, *cells, *(captions.duration(seconds) for seconds in sums)])
    return table


def render(table: Table, names: int | None = None) -> str:
    """A table as markdown; columns after the first `names`, which hold words, are set right."""
    names = names_in(table[0]) if names is None else names
    rule = ["---"] * names + ["---:"] * (len(table[0]) - names)
    rows = [[cell.replace("|", "\\|") for cell in row] for row in [table[0], rule, *table[1:]]]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def names_in(header: Sequence[str]) -> int:
    """How many of the first columns hold names, not numbers."""
    return sum(title in ("Group", "Method", "Against") for title in header)


def points(difference: tuple[float, float, float]) -> str:
    """E.g. `+13.5 [-2.7, +29.9]`, percentage points."""
    middle, low, high = (100 * x for x in difference)
    return f"{middle:+.1f} [{low:+.1f}, {high:+.1f}]"


def millimetres(value: float) -> str:
    """Three decimals, four below a hundredth, and no claim of less than 1e-4 mm."""
    return "<0.0001" if 0 < value < 1e-4 else f"{value:.4f}" if value < 0.01 else f"{value:.3f}"


def p_value(p: float) -> str:
    """Two digits, and no claim of more than 1e-4."""
    return "<0.0001" if p < 1e-4 else f"{p:.4f}" if p < 0.01 else f"{p:.2f}"


def _bin(trial: outcomes.Trial) -> int:
    return int(sweep.bin_of(trial["distance_m"]))


def _comparison(a: results.Run, b: results.Run, test: stats.Paired) -> tuple[object, ...]:
    """What two comparisons have in common that are one: the policies, by their weights or, where a
    result does not say whose it is, by their folders, and the trials' outcomes."""
    method = b.result["method"]
    place = b.path.parent if b.path.name == method else b.path
    return a.path, b.result.get("weights", place), methods.behaviour(method), test


def _seen_unseen(
    run: results.Run, test: Callable[[outcomes.Trial], bool]
) -> list[stats.Rate | None]:
    return [outcomes.tally(t, test) if t else None for t in outcomes.split(run.trials)]
