"""Sentences about the numbers, for the page and tables.md."""

from collections.abc import Sequence

from starjax.report import compare, formats, outcomes, results, stats

_ALIKE = 10.0  # points; an interval of the gap within them shows that success is alike
_WIDE = 40.0  # points; a wider interval says nothing
HELD_OUT = ("position_error_mm", "roll_error_deg")  # keys of metrics.jsonl


def title(runs: Sequence[results.Run]) -> str:
    """Returns the page's heading."""
    about = runs[0].label if len(runs) == 1 else several(runs)
    return f"{about} on {compare.task_text(runs).title}"


def several(runs: Sequence[results.Run]) -> str:
    """Counts methods and runs, e.g. `3 methods`, `4 runs of 2 methods`."""
    count = len({run.result.method for run in runs})
    methods = f"{count} method{'s' if count > 1 else ''}"
    return methods if count == len(runs) else f"{len(runs)} runs of {methods}"


def verdict(runs: Sequence[results.Run], focus: results.Run) -> str:
    """Summarises the result in one or two sentences."""
    seen, unseen = outcomes.rates(focus.trials)
    if seen is None and unseen is None:
        return f"{focus.label} was trained but not evaluated."
    done = f"{focus.label} {compare.task_text(runs).done} in"
    text = f"Through trocars it was trained on, {done} {formats.fraction(seen)}" if seen else ""
    if unseen and seen:
        percent = f"{100 * unseen.rate:.0f}%"
        text += f"; through trocars it had never met, in {unseen.successes} of {unseen.trials} "
        text += f"({percent}). {_gap(seen, unseen)}"
    elif unseen:
        text = f"Through trocars it had never met, {done} {formats.fraction(unseen)}."
    else:
        text += "."
    return f"{text} {_rank(runs, focus)}".rstrip()


def _gap(seen: stats.Rate, unseen: stats.Rate) -> str:
    middle, low, high = (100 * x for x in stats.gap(seen, unseen))
    if low > 0:
        lost = f"{middle:.1f} points (95% interval {low:.1f} to {high:.1f})"
        return f"A new trocar costs it {lost}."
    if high < 0:
        gained = f"{-middle:.1f} points (95% interval {-high:.1f} to {-low:.1f})"
        return f"It does better on the new ones, by {gained}."
    bounds = f"95% interval of the difference {low:+.1f} to {high:+.1f} points"
    if max(-low, high) <= _ALIKE:
        return f"It does as well on the new ones ({bounds})."
    if high - low > _WIDE:
        return f"So few trials cannot tell whether new trocars cost it anything ({bounds})."
    return f"The difference between the two may be chance ({bounds})."


def _rank(runs: Sequence[results.Run], focus: results.Run) -> str:
    """Returns a sentence on the best other run at unseen trocars."""
    scores = []
    for run in runs:
        unseen = outcomes.rates(run.trials)[1]
        if run is not focus and unseen:
            scores.append((unseen, run.label))
    if not scores:
        return ""
    best, label = max(scores, key=lambda score: (score[0].rate, score[1]))
    reached = f"{100 * best.rate:.0f}% ({best.successes} of {best.trials})"
    return f"The best of the others on new trocars, {label}, reached {reached}."


def distance(runs: Sequence[results.Run], focus: results.Run) -> str:
    """Returns the caption of Fig. 4."""
    several_, swept = len(runs) > 1, focus.sweep is not None
    left = (
        "Left: trials pooled by distance of their trocar to the nearest one in the demonstrations"
    )
    left += ", a line per run" if several_ else ""
    left += ", with 95% Wilson intervals"
    left += "." if several_ else "; n is the number of trials."
    if not (several_ or swept):
        left += " Faint dots are single trocars."
    right = (
        "Right: trocars of the sweep from above as dots, and the mean success over 8 mm about them."
        if swept
        else "Right: trocars from above, with the success in percent."
    )
    return f"{left} {right}"


def training(runs: Sequence[results.Run]) -> str:
    """Returns the caption of the training curves."""
    has_errors = any(name in line for run in runs for line in run.curves for name in HELD_OUT)
    errors = (
        ", and the error of predicted commands on demonstrations kept out of training (open loop)"
    )
    return f"Loss on the training batches{errors * has_errors}."


def notes(runs: Sequence[results.Run]) -> list[str]:
    """Lists the runs' warnings, each once with the labels it concerns, and differences in training
    and evaluation."""
    labels_of: dict[str, list[str]] = {}
    for run in runs:
        for text in run.result.about.get("warnings") or []:
            labels_of.setdefault(text, []).append(run.label)
    lines = [
        text if len(labels) == len(runs) else f"{', '.join(labels)}: {text}"
        for text, labels in labels_of.items()
    ]
    lines += [
        f"{run.label}: {' and '.join(run.others)} next to its result.json "
        f"{'is' if len(run.others) == 1 else 'are'} of other weights and ignored; "
        "starjax run scores the present ones."
        for run in runs
        if run.others
    ]
    within = [run for run in runs if run.rcm_error_mm.get("within_steps")]
    if within and len(within) < len(runs):
        names = ", ".join(run.label for run in runs if run not in within)
        lines.append(f"{names}: safe successes were read at the ends of control steps only.")
    if names := compare.differing(runs):
        lines.append(f"These runs were not trained alike: they differ in {', '.join(names)}.")
    limits = sorted({run.limit_s for run in runs if run.trials})
    if len(limits) > 1:
        allowed = ", ".join(f"{limit:g}" for limit in limits)
        lines.append(f"Trials were given {allowed} s; runs with different limits are not paired.")
    if len({tuple(sorted(results.jax_settings(run).items())) for run in runs if run.trials}) > 1:
        lines.append("These runs had other settings of jax; such runs are not paired.")
    lines += [
        f"{run.label}: the sweep's trials were given {results.sweep_limit_s(run):g} s, those "
        f"through the twelve trocars {run.limit_s:g} s; Fig. 4 shows the sweep's alone."
        for run in runs
        if run.sweep and results.sweep_limit_s(run) != run.limit_s
    ]
    return lines
