"""What the numbers say, in plain words."""

from collections.abc import Sequence
from typing import Any

from starjax.report import outcomes, results, stats


def title(runs: Sequence[results.Run]) -> str:
    """Heading of the page."""
    if len(runs) == 1:
        return f"{runs[0].label} on peg transfer"
    return f"{several(runs)} on peg transfer"


def several(runs: Sequence[results.Run]) -> str:
    """E.g. `3 methods`, `4 runs of 2 methods`."""
    count = len({run.result["method"] for run in runs})
    methods = f"{count} method{'s' if count > 1 else ''}"
    return methods if count == len(runs) else f"{len(runs)} runs of {methods}"


def verdict(runs: Sequence[results.Run], focus: results.Run) -> str:
    """One or two sentences that a reader in a hurry may stop after."""
    seen, unseen = (outcomes.tally(t) if t else None for t in outcomes.split(focus.trials))
    if seen is None and unseen is None:
        return f"{focus.label} was trained but not evaluated."
    known = f"Through trocars it was trained on, {focus.label} moved the block to its peg in "
    text = known + fraction(seen) if seen else ""
    if unseen and seen:
        percent = f"{100 * unseen.rate:.0f}%"
        text += f"; through trocars it had never met, in {unseen.successes} of {unseen.trials} "
        text += f"({percent}). {_gap(seen, unseen)}"
    elif unseen:
        text += known.replace("it was trained on", "it had never met") + fraction(unseen) + "."
    else:
        text += "."
    return f"{text} {_rank(runs, focus)}".rstrip()


def fraction(score: stats.Rate) -> str:
    """E.g. `40 of 48 trials (83%)`."""
    return f"{score.successes} of {score.trials} trials ({100 * score.rate:.0f}%)"


def interval(score: stats.Rate) -> str:
    """E.g. `95% interval 70-91%`."""
    return f"95% interval {100 * score.low:.0f}–{100 * score.high:.0f}%"


def duration(seconds: float) -> str:
    """E.g. `42 s`, `7 min 2 s`, `3 h 12 min`."""
    if seconds < 59.95:
        return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def hardware(found: dict[str, Any]) -> str:
    """E.g. `1 x NVIDIA H200, 16 cores of Intel Xeon, 128 GB`."""
    devices = found.get("devices") or []
    parts = []
    if found.get("backend") != "cpu":
        parts += [f"{devices.count(kind)} x {kind}" for kind in dict.fromkeys(devices)]
    if found.get("cpu"):
        parts.append(
            f"{found['cores']} cores of {found['cpu']}" if "cores" in found else found["cpu"]
        )
    if found.get("memory_gb"):
        parts.append(f"{found['memory_gb']:.0f} GB")
    return ", ".join(parts)


def machine(found: dict[str, Any]) -> str:
    """Its GPUs, e.g. `1 x NVIDIA H200`, or its cores where it has none."""
    if found.get("backend") == "cpu":
        return f"{found['cores']} cores of {found['cpu']}"
    devices = found["devices"]
    return ", ".join(f"{devices.count(kind)} x {kind}" for kind in dict.fromkeys(devices))


def listing(value: Any) -> str:
    """A small JSON value as a phrase."""
    if isinstance(value, dict):
        return ", ".join(f"{key} {listing(part)}" for key, part in value.items())
    if value is None:
        return "unknown"
    if isinstance(value, list):
        return ", ".join(listing(part) for part in value)
    return f"{value:g}" if isinstance(value, float) else str(value)


def _gap(seen: stats.Rate, unseen: stats.Rate) -> str:
    middle, low, high = (100 * x for x in stats.gap(seen, unseen))
    if low > 0:
        lost = f"{middle:.1f} points (95% interval {low:.1f} to {high:.1f})"
        return f"A new trocar costs it {lost}."
    if high < 0:
        gained = f"{-middle:.1f} points (95% interval {-high:.1f} to {-low:.1f})"
        return f"It does better on the new ones, by {gained}."
    bounds = f"{low:+.1f} to {high:+.1f} points"
    if middle == 0:
        return f"It does as well on the new ones (95% interval of the difference {bounds})."
    return f"The difference between the two may be chance (95% interval {bounds})."


def _rank(runs: Sequence[results.Run], focus: results.Run) -> str:
    """How the others do on unseen trocars, where methods are meant to differ."""
    scores = []
    for run in runs:
        unseen = outcomes.split(run.trials)[1]
        if run is not focus and unseen:
            scores.append((outcomes.tally(unseen).rate, run.label))
    if not scores:
        return ""
    best, label = max(scores)
    return f"The best of the others on new trocars, {label}, reached {100 * best:.0f}%."


def notes(runs: Sequence[results.Run]) -> list[str]:
    """Warnings of the runs, each once, with the names of those that it is about if not of all, and
    what sets their trainings apart."""
    said: dict[str, list[str]] = {}
    for run in runs:
        for text in run.result.get("warnings") or []:
            said.setdefault(text, []).append(run.label)
    found = [
        text if len(labels) == len(runs) else f"{', '.join(labels)}: {text}"
        for text, labels in said.items()
    ]
    found += [
        f"{run.label}: {' and '.join(run.others)} beside its result.json "
        f"{'is' if len(run.others) == 1 else 'are'} of other weights, and left out; "
        "starjax run scores the present ones."
        for run in runs
        if run.others
    ]
    within = [run for run in runs if (run.result.get("rcm_error_mm") or {}).get("within_steps")]
    if within and len(within) < len(runs):
        names = ", ".join(run.label for run in runs if run not in within)
        found.append(f"{names}: safe successes were read at the ends of control steps only.")
    if flags := results.differing(runs):
        found.append(f"These runs were not trained alike: they differ in {', '.join(flags)}.")
    limits = sorted({run.limit_s for run in runs if run.trials})
    if len(limits) > 1:
        allowed = ", ".join(f"{limit:g}" for limit in limits)
        found.append(f"Trials were given {allowed} s; runs with different limits are not paired.")
    found += [
        f"{run.label}: the sweep's trials were given {run.sweep_limit_s:g} s, those through the "
        f"twelve trocars {run.limit_s:g} s; Fig. 4 shows the sweep's alone."
        for run in runs
        if run.sweep and run.sweep_limit_s != run.limit_s
    ]
    return found
