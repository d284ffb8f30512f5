"""The report of one run or many: tables, figures, a video, rollouts in 3D, the page."""

import functools
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

from starjax.core import errors, extensions, methods
from starjax.report import (
    compare,
    figures,
    page,
    results,
    scene_view,
    stress,
    style,
    tables,
    training_trocars,
    trajectories,
    video,
)
from starjax.runtime import files
from starjax.sim.names import SceneNames


def build(
    runs: Sequence[pathlib.Path],
    out: pathlib.Path,
    with_video: bool = True,
    against: str = "",
    report: Callable[[str], None] = print,
) -> pathlib.Path:
    """Writes the report of the run directories `runs` into `out`; returns its index.html.

    Each directory holds the files that `results.load` reads; the report omits those that a run did
    not produce. There is no video without a recorded rollout or with `with_video` off. An earlier
    report in `out` stays until this one is complete; then its files that this page does not show
    are deleted, its video too. Paired tests compare the runs with those of the method `against`,
    or in all pairs, see `tables.paired`.

    Raises:
      errors.UsageError: no run is of the method `against`.
      ValueError: no runs, of several tasks, or a directory without a result.
      files.StorageError: another process is writing a report into `out`.
    """
    if not runs:
        raise ValueError("runs: expected at least one run directory, got none")
    loaded = _named_apart(sorted((results.load(path) for path in runs), key=_order))
    if against:
        names = [*dict.fromkeys(run.result.method for run in loaded), tables.ALL]
        errors.choice("against", against, names)
    return write(loaded, _focus(loaded), out, with_video, against, report)


def write(
    runs: Sequence[results.Run],
    focus: results.Run,
    out: pathlib.Path,
    with_video: bool = True,
    against: str = "",
    report: Callable[[str], None] = print,
    lead: page.PageLead | None = None,
) -> pathlib.Path:
    """Writes the report of loaded runs with labels of their own, see `build` and `page.render`."""
    recorded = any(run.rollouts for run in runs)
    with files.lock(out):
        text = tables.markdown(runs, against)
        pairs, drawn = _figures(runs, focus)
        film = _film(runs, out / _FILM, report) if with_video and recorded else None
        clip = film.read_bytes() if film else None
        playback = _playback(runs, report) if with_video and recorded else None
        html = page.render(runs, focus, pairs, clip, playback, against, lead)
        made = {"tables.md": text.encode(), **drawn, "index.html": html.encode()}
        made |= {_PLAYBACK: playback.html.encode()} if playback else {}
        for name, data in made.items():
            files.write_bytes(out / name, data)
        for name in _NAMES.difference(made, [film.name] if film else []):
            (out / name).unlink(missing_ok=True)  # an earlier report's
    return out / "index.html"


_FIGURES = ("training", "ports", "fig3", "fig4", "stress")
_FILM = "rollout.mp4"
_PLAYBACK = "rollout.html"
# Files that not every report has.
_NAMES = {_FILM, _PLAYBACK, *(f"{name}.{kind}" for name in _FIGURES for kind in ("png", "pdf"))}


def _order(run: results.Run) -> int:
    return list(methods.SCORED).index(run.result.method)


def _named_apart(runs: Sequence[results.Run]) -> list[results.Run]:
    """Makes labels unique by numbers of trocars, seeds or, failing these, folders."""
    return [run._replace(label=_name(run, runs)) for run in runs]


def _name(run: results.Run, runs: Sequence[results.Run]) -> str:
    alike = [other for other in runs if other.label == run.label]
    trocars = [training_trocars.trained_at(other) for other in alike]
    counts = {training_trocars.trained_at(other) for other in runs if other.trials}
    if run.trials and len(counts) > 1 and len(set(trocars)) == len(trocars):
        count = training_trocars.trained_at(run)
        return f"{run.label} ({count} trocar{'s' if count > 1 else ''})"
    if len(alike) == 1:
        return run.label
    if _all_apart([results.trained_seed(other) for other in alike]):
        return f"{run.label} (seed {results.trained_seed(run)})"
    if _all_apart([other.result.seed for other in alike]) and not compare.differing(alike):
        return f"{run.label} (trials of seed {run.result.seed})"
    return f"{run.label} ({_place(run, alike)})"


def _all_apart(seeds: Sequence[int | None]) -> bool:
    return None not in seeds and len(set(seeds)) == len(seeds)


def _place(run: results.Run, others: Sequence[results.Run]) -> str:
    """Returns the shortest end of a run's path that distinguishes it."""
    parts = [other.path.absolute().parts for other in others]
    for count in range(2, max(map(len, parts))):
        if len({path[-count:] for path in parts}) == len(parts):
            return "/".join(run.path.absolute().parts[-count:])
    return str(run.path)


def _film(
    runs: Sequence[results.Run], path: pathlib.Path, report: Callable[[str], None]
) -> pathlib.Path | None:
    """Writes the video; if that fails, reports the reason, because the page matters more."""
    try:
        film = video.record(runs, path, report)
    except (OSError, RuntimeError) as error:  # the encoder is a program outside Python
        report(f"no video: {error}")
        return None
    if film is None:
        report("no video: no trial was recorded with its joint positions")
    return film


def _playback(runs: Sequence[results.Run], report: Callable[[str], None]) -> page.Playback | None:
    """Records rollouts in 3D; if that fails, reports the reason."""
    record = extensions.hook("playback")
    if record is None:
        return None
    try:
        return record(runs)
    except (OSError, RuntimeError, errors.UsageError) as error:  # no trocar, or an unknown scene
        report(f"no rollouts in 3D: {error}")
        return None


def _focus(runs: Sequence[results.Run]) -> results.Run:
    """Selects the run whose numbers head the page: the paper's own method if present."""
    return next((run for run in runs if run.result.method == compare.OURS), runs[-1])


def _figures(
    runs: Sequence[results.Run], focus: results.Run
) -> tuple[dict[str, tuple[bytes, bytes]], dict[str, bytes]]:
    """Draws each figure on light and on dark paper; returns the pairs and the light files."""
    drawings: dict[str, Callable[[bool], Any]] = {
        "training": lambda dark: figures.training(runs, dark),
    }
    evaluated = [run for run in runs if run.trials]
    if evaluated and focus.trials:
        drawings["ports"] = lambda dark: training_trocars.draw(evaluated, dark)
        drawings["fig4"] = lambda dark: figures.distance(evaluated, focus, dark)
    if focus.stress:
        drawings["stress"] = lambda dark: stress.draw(focus.stress, dark)
    if any(run.rollouts for run in runs):
        shown = compare.representatives(runs)
        drawings["fig3"] = lambda dark: trajectories.draw(shown, _stage, dark)
    pairs, drawn = {}, {}
    for name, draw in drawings.items():
        light, dark = draw(False), draw(True)
        if light is not None:
            pairs[name] = style.save(light, "png"), style.save(dark, "png", dark=True)
            drawn[f"{name}.png"] = pairs[name][0]
            if name != "training":
                drawn[f"{name}.pdf"] = style.save(light, "pdf")
    return pairs, drawn


@functools.cache
def _stage(names: SceneNames) -> scene_view.SceneView:
    return scene_view.load(names)
