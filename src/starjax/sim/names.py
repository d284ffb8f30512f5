"""Names that tell which scene something was made in: they stand in datasets, policies, results."""

from typing import NamedTuple

from starjax import schema_1


class SceneNames(NamedTuple):
    """A scene by its parts' names in the registries.

    Attributes:
      task: key of `registries.tasks`.
      arms, tools: one for each arm slot of the task.
      cameras: that are observed.
    """

    task: str
    arms: tuple[str, ...]
    tools: tuple[str, ...]
    cameras: tuple[str, ...]


# The scene of everything that was stored before scenes had names (schema 1).
FIRST = SceneNames(*schema_1.SCENE)
