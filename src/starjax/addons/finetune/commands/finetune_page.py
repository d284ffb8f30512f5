"""The report of a fine-tuning: the policy before and after, and its rounds."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from starjax.cli import messages
from starjax.evaluation.paired import Paired
from starjax.report import build, compare, formats, outcomes, page, results, sections, sidecars
from starjax.report.sections import Card
from starjax.report.stats import Rate, rate

_LEVEL = 0.05  # significance level


def write(out: Path, content: Mapping[str, Any]) -> Path:
    """Writes the report of a finetune.json and the results next to it; returns its index.html."""
    best = content["best"]
    runs = [results.load(out / "before")._replace(label="Before")]
    if best:
        after = results.load(out / "after")._replace(label=f"After round {best}")
        log, curves = sidecars.curves(out / f"round_{best}", after.result)
        runs.append(after._replace(log=log, curves=curves))
    test = compare.pair(runs[-1], runs[0]) if best else None
    values = {
        "title": f"{compare.task_text(runs).title}, fine-tuned by {content['by']}".capitalize(),
        "verdict": _verdict(runs, test),
        "cards": list(_cards(runs, test)),
        "rounds": [_round(row, best) for row in content["rounds"]],
    }
    return build.write(
        runs,
        runs[-1],
        out / "report",
        report=messages.indented,
        lead=page.PageLead("finetune.html", values),
    )


def _verdict(runs: list[results.Run], test: Paired | None) -> str:
    before, after = (outcomes.tally(run.trials) for run in (runs[0], runs[-1]))
    done = compare.task_text(runs).done
    if test is None:
        kept = "No round is better in validation, so the policy is unchanged"
        return f"{kept}: it {done} in {formats.fraction(before)}."
    chance = "may be chance" if test.p >= _LEVEL else "is significant"
    return (
        f"The policy {done} in {formats.fraction(after)} after fine-tuning, "
        f"{formats.fraction(before)} before. The difference {chance} "
        f"(p {formats.p_value(test.p)}, paired)."
    )


def _cards(runs: list[results.Run], test: Paired | None) -> Iterator[Card]:
    for run in runs:
        score = outcomes.tally(run.trials)
        more = f"{score.successes} of {score.trials}, {formats.interval(score)}"
        yield Card(f"{run.label}, all trocars", f"{100 * score.rate:.0f}", "%", more, score, "seen")
    if test:
        change = 100 * (test.only_a - test.only_b) / test.pairs
        more = f"{test.only_a} trials succeed only after, {test.only_b} only before"
        yield Card("Change", f"{change:+.1f}", " points", more)
    yield from (card for card in sections.cards(runs[-1]) if card.unit in (" mm", " s"))


def _round(row: Mapping[str, Any], best: int) -> tuple[str, Rate, str]:
    """Returns name, success in validation and training episodes of a round."""
    name = str(row["round"]) if row["round"] else "0, the policy itself"
    won = row["validation"]
    learned = ""
    if "takeovers" in row:
        done, taken = (
            sum(cause[key] for cause in row["takeovers"].values())
            for key in ("successes", "trials")
        )
        learned = f"{row['learned']} episodes; the expert finished {done} of {taken} takeovers"
    elif "iterations" in row:
        learned = f"{len(row['iterations'])} iterations of {row['episodes']} episodes"
    kept = f"{name}, kept" if row["round"] == best else name
    return kept, rate(won["successes"], won["trials"]), learned
