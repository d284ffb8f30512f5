"""Recordings of another dataset by a mapping, for `starjax inspect`."""

from collections.abc import Callable
from pathlib import Path

from starjax.addons.formats import mapping as maps
from starjax.addons.formats import motion, selection, survey
from starjax.addons.formats.base import Source
from starjax.addons.formats.mapping import Map
from starjax.data.recordings import MAX_EPISODES, EpisodeMotion
from starjax.sim import registries


def recordings(
    source: Source, mapping: Map, folder: Path, note: Callable[[int], None] = lambda count: None
) -> tuple[list[EpisodeMotion], list[str]]:
    """Returns the motions of the first episodes that an import would keep, and its notes.

    Args:
      folder: of the mapping file.
      note: called with 1 after every episode.
    """
    source, mapping = survey.prepared(source, mapping, folder)
    found = survey.survey(source, mapping, folder, registries.tasks.get(mapping.task), note)
    made = []
    for kept, trocar in list(zip(found.kept, found.p_world_trocar))[:MAX_EPISODES]:
        _, poses = motion.of_episode(source, kept.episode, found.mapping, found.hz, folder)
        made.append(
            EpisodeMotion(
                kept.episode,
                motion.HZ,
                poses.shaft.R,
                poses.shaft.p,
                poses.pose.p,
                poses.gripper,
                trocar,
                kept.success,
                ", ".join(selection.splits_of(source, kept.episode)),
                poses.pose.R if maps.has_shaft(mapping) else None,
            )
        )
    return made, found.notes
