"""Names of a scene's parts, as stored in datasets, policies and results."""

from typing import NamedTuple


class SceneNames(NamedTuple):
    """A scene by its parts' names in the registries.

    Attributes:
      task: key of `registries.tasks`.
      arms, tools: one name per arm slot of the task.
      cameras: the observed ones.
    """

    task: str
    arms: tuple[str, ...]
    tools: tuple[str, ...]
    cameras: tuple[str, ...]


DEPTH = "_depth"  # ends the name of a view of depth, see `derived_views`
TISSUE = "_tissue"  # ends the name of a view with the look of a body cavity, see `camera.tissue`


def is_depth(camera: str) -> bool:
    """Returns True if the images of a camera's name hold depth instead of colours."""
    return camera.endswith(DEPTH)
