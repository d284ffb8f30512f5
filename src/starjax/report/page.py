"""One self-contained HTML page of a report, without links to other files.

Its only script is that of the rollouts in 3D, which are a page in a frame.
"""

import importlib.resources
from collections.abc import Mapping, Sequence

from starjax.report import captions, compare, markup, playback_3d, results, sections
from starjax.sim.tasks.base import TaskText

# name -> (light PNG, dark PNG)
Figures = Mapping[str, tuple[bytes, bytes]]

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
        "Trials at the trocars that none of these runs was trained at, with 95% Wilson intervals.",
    ),
    "stress": (
        "What breaks it",
        "Success and executed RCM error while one thing is wrong, around the circle; lines join "
        "levels of one rank, not one trial.",
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
    solid: playback_3d.Playback | None = None,
) -> str:
    """The page of `runs`, whose headline numbers are those of `focus`."""
    several = len(runs) > 1
    title, words = captions.title(runs), compare.words(runs)
    body = [
        f'<p class="eyebrow">starjax report</p><h1>{markup.escape(title)}</h1>',
        f'<p class="verdict">{markup.escape(captions.verdict(runs, focus))}</p>',
        sections.facts(runs),
        sections.warnings(runs),
        sections.cards(focus),
        _video(video, compare.observed(runs), words),
        _turned(solid),
        sections.comparison(runs) if several else sections.tests(focus),
        _figure("fig3", figures, words),
        _figure("fig4", figures, words),
        sections.swept(runs),
        _figure("ports", figures, words),
        _figure("stress", figures, words),
        sections.stressed(focus),
        sections.matrix(runs) if several else sections.per_trocar(focus),
        sections.failures(runs),
        sections.measurements(runs),
        _figure("training", figures, words),
        sections.reproduce(runs),
    ]
    style = importlib.resources.files("starjax.report").joinpath("page.css").read_text()
    return (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{markup.escape(title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n<main>\n"
        + "\n".join(part for part in body if part)
        + "\n</main>\n</body>\n</html>\n"
    )


def _figure(name: str, figures: Figures, words: TaskText) -> str:
    if name not in figures:
        return ""
    heading, caption = CAPTIONS[name][0], CAPTIONS[name][1].format(ground=words.ground)
    light, dark = (markup.uri("image/png", image) for image in figures[name])
    return (
        f"<h2>{heading}</h2>\n<figure><picture>"
        f'<source media="(prefers-color-scheme: dark)" srcset="{dark}">'
        f'<img src="{light}" alt="{markup.escape(caption)}"></picture>'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _video(video: bytes | None, observed: str, words: TaskText) -> str:
    if video is None:
        return ""
    source = markup.uri("video/mp4", video)
    return (
        f'<figure><video controls loop muted autoplay playsinline src="{source}"></video>'
        f"<figcaption>The policy, which sees the {observed}, at work in real time. The disc on the "
        f"shaft is the trocar; {words.goal}.</figcaption></figure>"
    )


def _turned(solid: playback_3d.Playback | None) -> str:
    """The rollouts in 3D, which a browser sets up when somebody opens them."""
    if solid is None:
        return ""
    said = f"In 3D, to be turned with the mouse: {solid.caption}"
    return (
        f"<details><summary>{markup.escape(said)}</summary>"
        f'<iframe title="{markup.escape(said)}" loading="lazy" sandbox="allow-scripts" '
        f'style="width:100%;height:32rem;border:0" srcdoc="{markup.escape(solid.html)}"></iframe>'
        "</details>"
    )
