"""One self-contained HTML page of a report, from the templates in `templates/`.

The page links to no other file. Its only script is that of the rollouts in 3D, a page in a frame.
"""

import base64
from collections.abc import Mapping, Sequence

import jinja2

from starjax.report import captions, compare, formats, notes, playback_3d, results, sections, stress

# name -> (light PNG, dark PNG)
Figures = Mapping[str, tuple[bytes, bytes]]

# name -> (heading, caption)
CAPTIONS = {
    "fig3": (
        "Rollouts",
        "Path of the instrument's tip over {ground} (top row: seen trocars, bottom row: unseen). "
        "Thin lines are the shaft at moments of one rollout, the cross is the trocar. "
        "Open circle: start. Grey line: the path seen from straight above.",
    ),
    "fig4": (
        "Success and distance from the training trocars",
        "Left: trials pooled by distance of their trocar to the nearest one in the demonstrations, "
        "with 95% Wilson intervals. Right: trocars from above; where a sweep filled the disc, its "
        "mean over 8 mm, its trocars as dots.",
    ),
    "ports": (
        "Success and the number of training trocars",
        "Trials at trocars unseen by all of these runs, with 95% Wilson intervals.",
    ),
    "stress": (
        "Success under disturbances",
        "Success and executed RCM error under one disturbance at a time, around the circle; lines "
        "join levels of one rank, not one trial.",
    ),
    "training": (
        "Training",
        "Loss on the training batches, and the error of predicted commands on demonstrations kept "
        "out of training (open loop).",
    ),
}


def render(
    runs: Sequence[results.Run],
    focus: results.Run,
    figures: Figures,
    video: bytes | None,
    playback: playback_3d.Playback | None = None,
) -> str:
    """Renders the page of `runs`, whose headline numbers are those of `focus`."""
    several = len(runs) > 1
    text = compare.task_text(runs)
    about = [run.result.about for run in runs]
    return (
        _environment()
        .get_template("page.html")
        .render(
            title=captions.title(runs),
            verdict=captions.verdict(runs, focus),
            facts=sections.facts(runs),
            warnings=captions.notes(runs),
            cards=list(sections.cards(focus)),
            video=video,
            playback=playback,
            observed=compare.observed(runs),
            goal=text.goal,
            several=several,
            focus=focus,
            scores=sections.by_method(runs) if several else sections.by_test(focus),
            comparisons=sections.comparisons(runs) if several else [],
            swept=sections.swept(runs),
            stressed=stress.table(focus.stress) if focus.stress else None,
            stress_note=stress.NOTE,
            trocars=[] if several else sections.trocars(focus),
            matrix=sections.matrix(runs) if several else None,
            failures=[] if several else sections.failures(focus),
            failures_note=notes.FAILURES,
            measurements=sections.measurements(runs),
            figures={
                name: {
                    "heading": heading,
                    "caption": caption.format(ground=text.ground),
                    "light": figures[name][0],
                    "dark": figures[name][1],
                }
                for name, (heading, caption) in CAPTIONS.items()
                if name in figures
            },
            commands=list(dict.fromkeys(x["command"] for x in about if x.get("command"))),
            settings=[
                (run.label, sections.flat(run.result.config)) for run in runs if run.result.config
            ],
            versions=formats.listing(about[0]["versions"]) if about[0].get("versions") else "",
        )
    )


def _environment() -> jinja2.Environment:
    loader = jinja2.PackageLoader("starjax.report")
    environment = jinja2.Environment(
        loader=loader,
        autoescape=True,  # labels, commands and settings come from files
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["data_uri"] = _data_uri
    return environment


def _data_uri(data: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
