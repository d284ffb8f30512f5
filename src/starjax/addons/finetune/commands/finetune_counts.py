"""Takeovers of a round: their causes, and the branches from which the expert succeeded."""

from typing import Any

from starjax.addons.finetune import dagger, rounds
from starjax.cli import messages
from starjax.evaluation import statistics
from starjax.sim.rollouts import progress

BRANCHES = ("takeover", *(f"{back:g} s" for back in dagger.REWINDS_S))


def report(outcomes: rounds.Outcomes) -> dict[str, Any]:
    """Prints and returns the counts of a round with takeovers.

    Returns:
      takeovers: cause -> success rate of the expert that continues from the takeover.
      branches: branch -> number of learned episodes.
      not_rescued: cause -> `[trocar, trial]` of the episodes that no branch rescues.
    """
    taken = outcomes.cause != progress.CAUSES[0]
    won, kept = outcomes.success[:, 0], outcomes.kept
    takeovers, not_rescued = {}, {}
    for cause in sorted(set(outcomes.cause[taken].tolist())):
        rows = outcomes.cause == cause
        takeovers[cause] = statistics.rate(won[rows])
        left = rows & ~kept
        later = int((kept & ~won)[rows].sum())
        messages.indented(
            f"{cause}: the expert finishes {messages.rate(takeovers[cause])}, "
            f"{later} more from an earlier state, {left.sum()} from none"
        )
        if left.any():
            pairs = zip(outcomes.trocar[left].tolist(), outcomes.trial[left].tolist(), strict=True)
            not_rescued[cause] = [list(pair) for pair in pairs]
    branches = {name: int((outcomes.run == run).sum()) for run, name in enumerate(BRANCHES)}
    messages.indented("learned from: " + ", ".join(f"{n}: {k}" for n, k in branches.items()))
    return {"takeovers": takeovers, "branches": branches, "not_rescued": not_rescued}
