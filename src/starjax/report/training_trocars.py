"""Success at unseen trocars by the number of training trocars."""

from collections.abc import Sequence
from typing import Any

from starjax.core import methods
from starjax.report import compare, outcomes, results, stats, style


def trained_at(run: results.Run) -> int:
    """Counts the trocars in the demonstrations of an evaluated run."""
    return len(results.training_trocars(run))


def never_seen(runs: Sequence[results.Run]) -> set[int]:
    """Returns the trocars that every run was scored at and that no run was trained at."""
    scored = [{trial.trocar for trial in run.trials} for run in runs]
    seen = {trial.trocar for run in runs for trial in run.trials if trial.seen}
    return set.intersection(*scored) - seen


def draw(runs: Sequence[results.Run], dark: bool = False) -> Any | None:
    """Draws success against the number of training trocars, a line per method.

    None unless the runs were trained at different numbers of trocars and have others in common.
    """
    counts, scored_at = sorted({trained_at(run) for run in runs}), never_seen(runs)
    if len(counts) < 2 or not scored_at:
        return None
    names = list(dict.fromkeys(run.result.method for run in runs))
    with style.use(dark):
        from matplotlib import ticker

        figure = style.figure(5.0, 3.2)
        axis = figure.subplots()
        for i, name in enumerate(names):
            ours = sorted((run for run in runs if run.result.method == name), key=trained_at)
            scores = [_score(run, scored_at) for run in ours]
            x = [trained_at(run) * 1.025 ** (i - (len(names) - 1) / 2) for run in ours]
            style.rates(axis, x, scores, name, methods.SCORED[name].label)
        axis.set_xscale("log", base=2)
        axis.set_xticks(counts, [str(count) for count in counts])
        axis.xaxis.set_minor_locator(ticker.NullLocator())
        axis.set_xlabel("trocars in the demonstrations")
        axis.set_ylabel("success rate")
        axis.set_title(
            f"At the {len(scored_at)} trocars that no run was trained at "
            f"(from {compare.observed(runs)})"
        )
        style.percent_axis(axis)
        style.legend(figure, *axis.get_legend_handles_labels(), side="left")
    return figure


def _score(run: results.Run, trocars: set[int]) -> stats.Rate:
    return outcomes.tally(trial for trial in run.trials if trial.trocar in trocars)
