"""Fine-tunings that begin with the best round of an earlier one, as one fine-tuning."""

from collections.abc import Mapping, Sequence
from typing import Any


def joined(
    found: Mapping[str, dict[str, Any]], continued: Mapping[str, Sequence[str]]
) -> list[dict[str, Any]]:
    """Returns the fine-tunings `found` by name, those named by `continued` as part of the first.

    Args:
      found: name -> finished fine-tuning.
      continued: name of a fine-tuning -> names of those that continue it, in order.
    """
    left = dict(found)
    for name, others in continued.items():
        for other in others:
            if name in left and other in left:
                left[name] = _join(left[name], left.pop(other))
    return list(left.values())


def _join(first: dict[str, Any], then: dict[str, Any]) -> dict[str, Any]:
    """Returns both as one; the second's demonstrations and features count for its first round."""
    by = len(first["rounds"]) - 1
    rounds = [{**row, "round": row["round"] + by} for row in then["rounds"][1:]]
    timings = dict(first["timings_s"])
    for stage, seconds in then["timings_s"].items():
        words = stage.split(" ", 2)
        if words[0] == "round":
            stage = f"round {int(words[1]) + by} {words[2]}"
        elif words[0] in ("collect", "features"):
            stage = f"round {1 + by} {stage}"
        timings[stage] = timings.get(stage, 0.0) + seconds
    best = then["best"] + by if then["best"] else first["best"]
    after = {"after": then["after"]} if then["best"] else {}
    parts = {"rounds": [*first["rounds"], *rounds], "timings_s": timings, "best": best}
    return {**first, **parts, **after}
