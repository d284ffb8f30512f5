"""The page and the other files of a stress.json: `starjax stress`."""

from collections.abc import Iterator, Mapping
from typing import Any

from starjax.core import methods
from starjax.report import formats, page, sections, stats, stress, style
from starjax.sim import registries

_ERROR = "RCM p99 (mm)"  # name in `stress.StressRow.measured`
_NAMED = 4  # disturbances in a sentence; more are counted


def files(content: Mapping[str, Any], failed: formats.Table) -> dict[str, bytes]:
    """Makes the page, the table and the figure of a stress.json, by name.

    Args:
      content: of stress.json.
      failed: rows of its failed trials, header first and a command last; may be empty.
    """
    light, dark = stress.draw(content), stress.draw(content, dark=True)
    png = style.save(light, "png")
    label = methods.SCORED[content["method"]].label
    text = registries.tasks.get(content["scene"]["task"]).text
    html = (
        page.environment()
        .get_template("stress.html")
        .render(
            title=f"{label} on {text.title}, disturbed",
            verdict=verdict(content, f"{label} {text.done} in"),
            facts=_facts(content),
            cards=list(cards(content)),
            content=content,
            figure=(png, style.save(dark, "png", dark=True)),
            failed=failed,
        )
    )
    return {
        "index.html": html.encode(),
        "stress.md": stress.markdown(content).encode(),
        "stress.png": png,
        "stress.pdf": style.save(light, "pdf"),
    }


def verdict(content: Mapping[str, Any], done: str) -> str:
    """Summarises success without and under disturbances; `done` names the policy and the task."""
    found = stress.scores(content)
    plain = next((score.success for score in found if score.is_undisturbed), None)
    if plain is None:
        low = min(found, key=lambda score: score.success.rate)
        return f"Under {_named(low)}, {done} {formats.fraction(low.success)}."
    lowered: dict[str, str] = {}
    for score in found:
        if stats.gap(plain, score.success)[1] > 0:
            lowered.setdefault(score.name, f"{_named(score)} ({100 * score.success.rate:.0f}%)")
    kept = [name for name in dict.fromkeys(score.name for score in found) if name not in lowered]
    parts = [f"The first levels with a significant loss are {', '.join(lowered.values())}."]
    if kept:
        names = ", ".join(kept) if len(kept) <= _NAMED else f"the other {len(kept)} disturbances"
        parts = [*parts[: len(lowered)], f"No loss is significant under {names}."]
    return " ".join([f"Undisturbed, {done} {formats.fraction(plain)}.", *parts])


def cards(content: Mapping[str, Any]) -> Iterator[sections.Card]:
    """Yields success without disturbances and at its lowest, and the largest RCM error."""
    found = stress.scores(content)
    plain = [score for score in found if score.is_undisturbed][:1]
    low = min(found, key=lambda score: score.success.rate)
    for name, scores, part in (("Undisturbed", plain, "seen"), ("Lowest success", [low], "unseen")):
        for score in scores:
            where = "" if score.is_undisturbed else f"{_named(score)}: "
            more = f"{where}{score.success.successes} of {score.success.trials}, "
            more += formats.interval(score.success)
            rate = f"{100 * score.success.rate:.0f}"
            yield sections.Card(name, rate, "%", more, score.success, part)
    if known := [score for score in found if score.measured[_ERROR] != "\u2013"]:
        most = max(known, key=lambda score: float(score.measured[_ERROR]))
        more = f"99th percentile under {_named(most)}"
        more += "".join(f"; {score.measured[_ERROR]} mm undisturbed" for score in plain)
        yield sections.Card("Shaft off the trocar, at most", most.measured[_ERROR], " mm", more)


def _facts(content: Mapping[str, Any]) -> list[tuple[str, str]]:
    scene, trials = content["scene"], next(iter(stress.scores(content))).success.trials
    return [
        ("Trials per level", f"{trials}, of {content['time_limit_s']:g} s at most"),
        ("Robot", sections.robot(scene["arms"], scene["tools"])),
        ("Weights", content["weights"][:10]),
        ("Seed of the trials", str(content["seed"])),
        ("Code", formats.code(content.get("commit"), content.get("dirty"))),
        ("Hardware", formats.hardware(content.get("hardware") or {})),
    ]


def _named(score: stress.StressRow) -> str:
    return f"{score.name} {score.level}"
