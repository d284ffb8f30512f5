"""Tables of the paper: success (III), paired tests, RCM error, inference time (IV)."""

import itertools
from collections.abc import Callable, Sequence

from starjax.core import methods
from starjax.evaluation import sweep
from starjax.evaluation.paired import Paired
from starjax.evaluation.result import Trial
from starjax.report import captions, compare, formats, notes, outcomes, results, stats
from starjax.report.formats import Table

TESTS = {"strict": outcomes.strict, "loose": outcomes.loose, "safe": outcomes.safe}
SWEPT = "Success through other trocars (%)"
SWEPT_PAIRED = "through these trocars"
ALL = "all"  # for --against: every pair of runs
_QUANTILES = ("p50", "p95", "p99")
_COMPILE = ": compile"  # suffix of a phase's compile time


def markdown(runs: Sequence[results.Run], against: str = "") -> str:
    """Renders tables.md: every table with numbers, each with a note; `against` as in `paired`."""
    text, title = compare.task_text(runs), paired_title(runs, against)
    parts = [
        (f"Table III. Task success on {text.title} (%)", success(runs), notes.SUCCESS),
        ("Success by three tests (%)", by_test(runs), notes.by_test(text)),
        (title, paired(runs, against), notes.PAIRED),
        (SWEPT, swept(runs), f"{notes.SWEPT} {notes.CELL}"),
        (f"{title} {SWEPT_PAIRED}", paired(results.swept(runs), against), notes.PAIRED),
        ("Failed trials", failures(runs), notes.FAILURES),
        ("RCM error (mm)", rcm(runs), notes.RCM),
        ("Table IV. Inference time", inference(runs), notes.inference(runs)),
    ]
    filled = [f"## {h}\n\n{formats.render(t)}\n\n{note}\n" for h, t, note in parts if len(t) > 1]
    warnings = "".join(f"- {line}\n" for line in captions.notes(runs))
    head = f"# {formats.sentence(text.title)} from {compare.observed(runs)} observations\n"
    return "\n".join(part for part in (head, warnings, *filled) if part)


def success(runs: Sequence[results.Run]) -> Table:
    """Makes Table III."""
    table = [["Group", "Method", "Seen ↑", "Unseen ↑", "Gap ↓"]]
    scores = [(run, outcomes.rates(run.trials)) for run in runs if run.trials]
    best = [max((s.rate for _, pair in scores if (s := pair[i])), default=0.0) for i in (0, 1)]
    for run, (seen, unseen) in scores:
        cells = [formats.rate(score) if score else "–" for score in (seen, unseen)]
        for part, score in enumerate((seen, unseen)):
            if len(scores) > 1 and score and score.rate == best[part] > 0:
                cells[part] = f"**{cells[part]}**"
        cells.append(formats.points(stats.gap(seen, unseen)) if seen and unseen else "–")
        table.append([run.group, run.label, *cells])
    return table


def by_test(runs: Sequence[results.Run], cell: Callable[[stats.Rate], str] = formats.rate) -> Table:
    """Makes the table of strict, loose and safe success, seen and unseen."""
    header = [f"{name.capitalize()}, {part}" for name in TESTS for part in ("seen", "unseen")]
    table = [["Method", *header]]
    for run in runs:
        if run.trials:
            scores = [s for test in TESTS.values() for s in outcomes.rates(run.trials, test)]
            table.append([run.label, *(cell(s) if s else "–" for s in scores)])
    return table


def swept(runs: Sequence[results.Run], cell: Callable[[stats.Rate], str] = formats.rate) -> Table:
    """Makes the table of sweeps: strict, safe, and strict by distance to the training trocars."""
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
    """Makes the table of failed trials by class; empty classes are omitted."""
    counts = [(run.label, outcomes.failures(run.trials)) for run in runs if run.trials]
    classes = [key for key in outcomes.SHORT if any(key in own for _, own in counts)]
    table = [["Method", *(outcomes.SHORT[key].capitalize() for key in classes)]]
    if classes:
        table += [[label, *(str(own.get(k, 0)) for k in classes)] for label, own in counts]
    return table


def paired(runs: Sequence[results.Run], against: str = "") -> Table:
    """Makes the table of McNemar's tests of runs with the same trials, Holm over all its rows.

    Args:
      runs: any runs.
      against: method that the others are compared with, `ALL` for every pair; by default STAR-Diff,
        or every pair without it.
    """
    reference = reference_of(runs, against)
    if reference == ALL:
        pairs = [p for p in itertools.combinations(runs, 2) if _policy(p[0]) != _policy(p[1])]
    else:
        ours = [run for run in runs if run.result.method == reference]
        others = [run for run in runs if run.result.method != reference]
        pairs = [*itertools.product(ours, others), *itertools.combinations(ours, 2)]
    tested = [(a, b, test) for a, b in pairs if (test := compare.pair(a, b))]
    first = {a.path: a.label for a, *_ in tested}
    is_one = reference != ALL and len({a.path for a, _ in pairs}) == 1
    names = ["Against", *_only(next(iter(first.values()), ""), "the other")]
    if not is_one:
        names = ["First against second", *_only("the first", "the second")]
    # Methods with one policy, such as DP-RCM-4 and STAR-Diff-Single, count once for Holm.
    single = {_comparison(a, b, test): test.p for a, b, test in tested}
    corrected = dict(zip(single, stats.holm(list(single.values())), strict=True))
    table = [[names[0], "Pairs", *names[1:], "p", "p (Holm)"]]
    for a, b, test in tested:
        p = corrected[_comparison(a, b, test)]
        counts = [str(n) for n in (test.pairs, test.only_a, test.only_b)]
        name = b.label if is_one else f"{a.label} against {b.label}"
        table.append([name, *counts, formats.p_value(test.p), formats.p_value(p)])
    return table


def reference_of(runs: Sequence[results.Run], against: str) -> str:
    """Returns the method that `paired` compares the others with, or `ALL`."""
    has_ours = any(run.result.method == compare.OURS for run in runs)
    return against or (compare.OURS if has_ours else ALL)


def paired_title(runs: Sequence[results.Run], against: str) -> str:
    """Returns the heading of `paired`."""
    reference = reference_of(runs, against)
    label = methods.SCORED[reference].label if reference in methods.SCORED else ""
    return f"Paired comparison with {label}" if label else "Paired comparison of all methods"


def _only(*names: str) -> list[str]:
    return [f"Only {name}" for name in names]


def rcm(runs: Sequence[results.Run]) -> Table:
    """Makes the table of RCM errors, commanded and executed, at and within control steps."""
    keys = [("commanded", "max")]
    keys += [("executed", figure) for figure in ("mean", "p99_of_successes", "p99", "max")]
    keys += [("within_steps", figure) for figure in ("p99", "max")]
    names = (f"{kind.capitalize()} {figure}".replace("_", " ") for kind, figure in keys)
    table = [["Method", *names]]
    for run in runs:
        values = [(run.rcm_error_mm.get(kind) or {}).get(figure) for kind, figure in keys]
        if any(v is not None for v in values):
            cells = ("–" if v is None else formats.millimetres(v) for v in values)
            table.append([run.label, *cells])
    return table


def inference(runs: Sequence[results.Run]) -> Table:
    """Makes Table IV: latency in ms and its rate, a row per method and number of DDIM steps."""
    table = [["Method", "DDIM steps", "p50 (ms)", "p95 (ms)", "p99 (ms)", "p50 (Hz)", "p99 (Hz)"]]
    for run in runs:
        rows = [(run.label, str(steps), ms) for steps, ms in results.latencies(run)]
        if roll := (run.bench or run.result.about).get("roll_network_ms"):
            rows.append((f"{run.label}, roll network alone", "–", roll))
        for name, steps, ms in rows:
            times = [f"{ms[q]:.3f}" if ms["p50"] < 1 else f"{ms[q]:.1f}" for q in _QUANTILES]
            hertz = [f"{1e3 / ms[q]:.0f}" for q in ("p50", "p99")]
            table.append([name, steps, *times, *hertz])
    return table


def phases(runs: Sequence[results.Run]) -> Table:
    """Makes the table of wall-clock times of each result's phases."""
    times = [(run.label, run.result.about.get("timings_s") or {}) for run in runs]
    every = dict.fromkeys(name for _, spent in times for name in spent)
    names = [name for name in every if not name.endswith(_COMPILE)]
    table = [["Method", *(name.capitalize() for name in names), "Total", "Compiling (included)"]]
    for label, spent in times:
        if any(name in spent for name in names):
            sums = [sum(spent.get(n + end, 0.0) for n in names) for end in ("", _COMPILE)]
            cells = [formats.duration(spent[n]) if n in spent else "–" for n in names]
            table.append([label, *cells, *(formats.duration(seconds) for seconds in sums)])
    return table


def _bin(trial: Trial) -> int:
    return int(sweep.bin_of(trial.distance_m or 0.0))


def _comparison(a: results.Run, b: results.Run, test: Paired) -> tuple[object, ...]:
    """Returns the identity of a comparison: two policies and their trials' outcomes."""
    return _policy(a), _policy(b), test


def _policy(run: results.Run) -> tuple[object, ...]:
    """Identifies a policy by its weights, or by its folder if the result does not name them."""
    method = run.result.method
    place = run.path.parent if run.path.name == method else run.path
    return run.result.weights or place, methods.behaviour(method)
