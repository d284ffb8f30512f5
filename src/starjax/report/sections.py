"""The parts of the HTML page, each empty where a run left nothing to say."""

import statistics
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from starjax.evaluation.result import Trial
from starjax.report import (
    captions,
    compare,
    formats,
    markup,
    notes,
    outcomes,
    results,
    stats,
    stress,
    tables,
)
from starjax.report.markup import Cell
from starjax.sim.names import SceneNames

_BARS_NOTE = (
    "Bars are 95% Wilson intervals, ticks the rates. The gap is seen minus unseen with Newcombe's "
    "95% interval; it means little where both are low."
)
_SCORES = (Cell("Seen", span=2), Cell("Unseen", span=2))


def facts(runs: Sequence[results.Run]) -> str:
    """Settings and machines of the runs, each once."""
    items = {
        "Observation": [compare.observed(runs)],
        "Trials" if len(runs) == 1 else "Trials a run": [_trials(run) for run in runs],
        "Robot": [_robot(run.result.scene) for run in runs],
        "Preset": [run.result.config.get("preset") for run in runs],
        "Seed": [results.trained_seed(run) for run in runs],
        "Seed of the trials": _trials_seeds(runs),
        "Code": [formats.code(run.result.commit, run.result.dirty) for run in runs],
        "Hardware": [formats.hardware(run.result.about.get("hardware") or {}) for run in runs],
    }
    inner = ""
    for name, values in items.items():
        found = dict.fromkeys(str(value) for value in values if value not in (None, ""))
        if found:
            inner += f"<div><dt>{name}</dt><dd>{markup.escape('; '.join(found))}</dd></div>"
    return f'<dl class="facts">{inner}</dl>'


def _trials_seeds(runs: Sequence[results.Run]) -> list[int | None]:
    """Seeds of the trials, unless each is that of its training."""
    trained = [results.trained_seed(run) for run in runs]
    scored = [run.result.seed for run in runs]
    return [] if scored == trained else scored


def _robot(scene: SceneNames) -> str:
    """E.g. `fr5 with grasper`."""
    arms = zip(scene.arms, scene.tools, strict=True)
    return " and ".join(f"{arm} with {tool}" for arm, tool in arms)


def _trials(run: results.Run) -> str:
    trocars = len(outcomes.by_trocar(run.trials))
    return f"{len(run.trials)} over {trocars} trocars" if trocars else ""


def warnings(runs: Sequence[results.Run]) -> str:
    """Warnings, each once."""
    return "\n".join(f'<p class="note">{markup.escape(text)}</p>' for text in captions.notes(runs))


def cards(run: results.Run) -> str:
    """Headline numbers with their intervals."""
    inner = "".join(
        f'<div class="card"><div class="name">{name}</div>'
        f'<div class="value">{value}<small>{unit}</small></div><div class="more">{more}</div></div>'
        for name, value, unit, more in _headlines(run)
    )
    return f'<div class="cards">{inner}</div>' if inner else ""


def _headlines(run: results.Run) -> Iterator[tuple[str, str, str, str]]:
    """(name, value, unit, more) of each headline number that the run has."""
    scores = [outcomes.tally(t) if t else None for t in outcomes.split(run.trials)]
    for name, score in zip(("seen", "unseen"), scores):
        if score:
            more = f"{score.successes} of {score.trials}, {formats.interval(score)}"
            bar = markup.interval(score, name)
            yield f"Success, {name} trocars", f"{100 * score.rate:.0f}", "%", bar + more
    seen, unseen = scores
    if seen and unseen:
        middle, low, high = (100 * x for x in stats.gap(seen, unseen))
        more = f"seen minus unseen, 95% interval {low:+.0f} to {high:+.0f}"
        yield "Generalization gap", f"{middle:+.0f}", " points", more
    errors = run.rcm_error_mm
    executed = errors.get("executed") or {}
    if executed.get("p99") is not None:
        worst = max(executed["max"], (errors.get("within_steps") or {}).get("max", 0.0))
        more = f"99th percentile of steps' ends; {formats.millimetres(worst)} mm at worst"
        yield "Shaft off the trocar", formats.millimetres(executed["p99"]), " mm", more
    if seconds := outcomes.times(run.trials, run.result.control_hz):
        more = f"median of {len(seconds)} successes"
        yield "Time of a success", f"{statistics.median(seconds):.1f}", " s", more
    if ms := run.result.about.get("inference_ms"):
        more = f"median; 99th percentile {ms['p99']:.1f} ms"
        yield "One policy call", f"{ms['p50']:.1f}", " ms", more


def tests(run: results.Run) -> str:
    """One method: success by three tests."""
    if not run.trials:
        return ""
    rows = []
    meanings = notes.tests(compare.words([run]))
    for name, test in tables.TESTS.items():
        said = f"<b>{name.capitalize()}</b><br>{markup.escape(meanings[name])}"
        rows.append([Cell(said, "wide")])
        for part, trials in zip(("seen", "unseen"), outcomes.split(run.trials)):
            rows[-1] += markup.score(outcomes.tally(trials, test) if trials else None, part)
    return "<h2>Success</h2>\n" + markup.table([Cell("Test"), *_SCORES], rows)


def comparison(runs: Sequence[results.Run]) -> str:
    """Several methods: Table III with its intervals drawn, paired tests, the other tests."""
    rows, group = [], None
    for run in runs:
        if run.trials:
            if run.group != group:
                group = run.group
                rows.append([Cell(markup.escape(group), "group"), *[Cell("", "group")] * 5])
            scores = [outcomes.tally(t) if t else None for t in outcomes.split(run.trials)]
            seen, unseen = scores
            gap = formats.points(stats.gap(seen, unseen)) if seen and unseen else "–"
            rows.append([Cell(markup.escape(run.label)), *markup.score(seen, "seen")])
            rows[-1] += [*markup.score(unseen, "unseen"), markup.number(gap)]
    if not rows:
        return ""
    header = [Cell("Method"), *_SCORES, markup.number("Gap (points)")]
    text = "<h2>Success</h2>\n" + markup.table(header, rows) + markup.small(_BARS_NOTE)
    pairs = tables.paired(runs)
    if len(pairs) > 1:
        text += "<h2>Paired with STAR-Diff</h2>\n" + markup.plain(pairs, notes.PAIRED)
    words = compare.words(runs)
    others = markup.plain(tables.by_test(runs, formats.brief), notes.by_test(words))
    return text + "<h2>Success by three tests (%)</h2>\n" + others


def swept(runs: Sequence[results.Run]) -> str:
    """Success through the trocars of sweeps; of several methods, paired tests too."""
    parts = (
        (tables.SWEPT, tables.swept(runs, formats.brief), notes.SWEPT),
        (tables.SWEPT_PAIRED, tables.paired(results.swept(runs)), notes.PAIRED),
    )
    return _titled(parts)


def stressed(run: results.Run) -> str:
    """A row for each level of each disturbance."""
    if not run.stress:
        return ""
    rows = stress.table(run.stress)
    cells = [[Cell(markup.escape(t)) for t in r[:2]] + [*map(markup.number, r[2:])] for r in rows]
    return markup.table(cells[0], cells[1:]) + markup.small(stress.NOTE)


def per_trocar(run: results.Run) -> str:
    """One method: a row a trocar."""
    rows = []
    for group in outcomes.by_trocar(run.trials):
        part = "seen" if group[0].seen else "unseen"
        times = outcomes.times(group, run.result.control_hz)
        worst = max((e for t in group if (e := outcomes.worst_rcm_mm(t)) is not None), default=None)
        row = [Cell(f"{group[0].trocar}"), Cell(part)]
        row += [markup.number(text) for text in outcomes.place(group[0])]
        row += markup.score(outcomes.tally(group), part)
        row.append(markup.number(f"{statistics.median(times):.1f} s" if times else "–"))
        row.append(markup.number("–" if worst is None else f"{formats.millimetres(worst)} mm"))
        rows.append(row)
    if not rows:
        return ""
    right = [markup.number(text) for text in ("r", "θ", "φ")]
    header = [Cell("Trocar", span=2), *right, Cell("Success", span=2)]
    header += [markup.number("Median time"), markup.number("Worst RCM error")]
    return "<h2>Trocar by trocar</h2>\n" + markup.table(header, rows)


def matrix(runs: Sequence[results.Run]) -> str:
    """Several methods: success in percent, a row a method and a column a trocar."""
    columns = outcomes.by_trocar([trial for run in runs for trial in run.trials])
    if not columns:
        return ""
    header, rows = [Cell("Method")], []
    for group in columns:
        header.append(Cell(f"{group[0].trocar}", "tint"))
    for run in runs:
        own = {group[0].trocar: group for group in outcomes.by_trocar(run.trials)}
        cells = [_at_trocar(own.get(group[0].trocar)) for group in columns]
        rows.append([Cell(markup.escape(run.label)), *cells])
    note = "Success in percent of the trials at each trocar; * where it was not trained on."
    return "<h2>Trocar by trocar</h2>\n" + markup.table(header, rows) + markup.small(note)


def _at_trocar(trials: Sequence[Trial] | None) -> Cell:
    if not trials:
        return Cell("", "tint")
    return markup.tint(outcomes.tally(trials), "" if trials[0].seen else "*")


def failures(runs: Sequence[results.Run]) -> str:
    """How the failed trials failed: bars for one method, a table for several."""
    if len(runs) > 1:
        table = tables.failures(runs)
        said = markup.plain(table, notes.FAILURES)
        return f"<h2>Failed trials</h2>\n{said}" if len(table) > 1 else ""
    found = outcomes.failures(runs[0].trials)
    if not found:
        return ""
    meanings = outcomes.meanings(compare.words(runs))
    lines = "".join(
        f"<div>{markup.escape(meanings[key])}</div>"
        f'<span class="unseen"><i style="width:{80 * n / max(found.values()):.1f}%"></i>{n}</span>'
        for key, n in found.items()
    )
    said = f"{sum(found.values())} of {len(runs[0].trials)} trials failed."
    note = markup.small(notes.FAILURES)
    return f'<h2>How it failed</h2>\n<p>{said}</p><div class="bars">{lines}</div>{note}'


def measurements(runs: Sequence[results.Run]) -> str:
    """RCM error, inference time (Table IV), wall-clock time a phase."""
    parts = (
        ("RCM error (mm)", tables.rcm(runs), notes.RCM),
        ("Inference time", tables.inference(runs), notes.inference(runs)),
        ("Where the time went", tables.phases(runs), notes.PHASES),
    )
    return _titled(parts)


def reproduce(runs: Sequence[results.Run]) -> str:
    """Commands, settings, versions."""
    commands = dict.fromkeys(run.result.about.get("command") for run in runs)
    text = "<h2>Run it again</h2>\n" if any(commands) else ""
    text += "".join(f"<pre>{markup.escape(command)}</pre>" for command in commands if command)
    for run in runs:
        lines = "\n".join(_flat(run.result.config))
        if lines:
            summary = f"<summary>Settings of {markup.escape(run.label)}</summary>"
            text += f"<details>{summary}<pre>{markup.escape(lines)}</pre></details>\n"
    versions = runs[0].result.about.get("versions")
    return text + (
        f"<footer>{markup.escape(formats.listing(versions))}</footer>" if versions else ""
    )


def _titled(parts: Iterable[tuple[str, formats.Table, str]]) -> str:
    """Tables under their headings, each with its note, those of no rows left out."""
    return "\n".join(f"<h2>{h}</h2>\n{markup.plain(t, n)}" for h, t, n in parts if len(t) > 1)


def _flat(config: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    for name, value in config.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name} = {formats.listing(value)}"
