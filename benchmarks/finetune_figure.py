"""Draws success in validation against the time of fine-tuning, a panel per task.

python benchmarks/finetune_figure.py FIGURE.png
"""

import itertools
import sys
from pathlib import Path
from typing import Any

import finetuned

from starjax.report import style

WAYS = {"dagger": "#2083C5", "self": "#D55E00", "rl": "#009E73", "distill": "#CC79A7"}
COLUMNS = 3
AGAIN = 0.5  # opacity of a second line of the same policy and way


def main(file: Path) -> None:
    """Writes the figure: a line per fine-tuning, with the 95% interval of every round."""
    found = finetuned.finetunings()
    tasks = {task: list(group) for task, group in itertools.groupby(found, key=lambda x: x["task"])}
    with style.use():
        rows = -(-len(tasks) // COLUMNS)
        figure = style.figure(2.6 * COLUMNS, 3.4 * rows)
        axes = figure.subplots(rows, COLUMNS, squeeze=False)
        for axis in axes.flat[len(tasks) :]:
            axis.set_axis_off()
        for axis, (task, results) in zip(axes.flat, tasks.items(), strict=False):
            draw(axis, task, results)
        for axis in axes[:, 0]:
            axis.set_ylabel("success in validation (%)")
        data = style.save(figure, "png")
    file.write_bytes(data)


def draw(axis: Any, task: str, results: list[dict[str, Any]]) -> None:
    """Draws the fine-tunings of one task."""
    lines = dict(zip(dict.fromkeys(map(finetuned.base, results)), ("-", ":", "--", "-.")))
    labels = [f"{found['by']}, {finetuned.base(found)}" for found in results]
    for i, found in enumerate(results):
        minutes = [seconds / 60 for seconds in finetuned.learning_seconds(found)]
        rates = [row["validation"] for row in found["rounds"]]
        middle = [100 * rate["rate"] for rate in rates]
        low, high = (
            [abs(100 * rate["ci95"][end] - y) for rate, y in zip(rates, middle, strict=True)]
            for end in (0, 1)
        )
        label, twice = labels[i], labels.count(labels[i]) > 1
        look: dict[str, Any] = {"color": WAYS[found["by"]], "ls": lines[finetuned.base(found)]}
        look["alpha"] = AGAIN ** labels[:i].count(label)
        axis.errorbar(
            minutes,
            middle,
            (low, high),
            marker="o",
            ms=4,
            capsize=2,
            label=f"{label}, {found['commit'][:8]}" if twice else label,
            **look,
        )
    goals = sorted({finetuned.goal_of(found)[0] for found in results})
    for goal in goals:
        axis.axhline(goal, color="black", lw=0.8, ls="--")
    named = ", ".join(f"{goal:.0f}%" for goal in goals)
    axis.plot([], [], color="black", lw=0.8, ls="--", label=f"goals of policies: {named}")
    axis.set(title=task.replace("_", " "), xlabel="rollouts and training (min)")
    axis.set_ylim(top=101)
    axis.legend(fontsize=7, loc="upper left", bbox_to_anchor=(0.0, -0.22), borderaxespad=0.0)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
