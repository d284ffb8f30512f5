"""The page of `starjax inspect DATASET --page`: motions of any dataset with figures."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from starjax.core import errors, extensions, extras
from starjax.runtime import files

if TYPE_CHECKING:
    import numpy as np

_MOMENTS = 6  # images of an episode


def write(
    path: Path,
    map_name: str,
    page: Path,
    rows: Sequence[tuple[str, str]],
    odd: Sequence[str],
    image_size: int = 0,
) -> list[str]:
    """Writes the page; returns all anomalies, those of the mapping too.

    Args:
      path: a dataset of starjax, or one of another format.
      map_name: mapping of the other format, as of `starjax import`; empty for the one that fits.
      page: the file.
      rows: summary of the dataset.
      odd: its anomalies.
      image_size: pixels per side of drawn images of one episode, of a dataset of starjax; 0: none.

    Raises:
      errors.UsageError: no mapping fits, or no motion is left.
    """
    extras.require("inspect --page", "report")
    from starjax.addons.viewer import recording_page
    from starjax.data import recordings

    notes: list[str] = []
    images: dict[str, np.ndarray] = {}
    if (path / "dataset.json").is_file():
        found = list(recordings.of_dataset(path))
        images = _images(path, image_size) if image_size else {}
    else:
        found, notes = extensions.hook("inspect_page")(path, map_name)
    if not found:
        raise errors.UsageError("PATH", "episodes with motions", f"none in {path}")
    notes = list(dict.fromkeys([*odd, *notes]))
    text = recording_page.render(path.name, rows, found, notes, images)
    files.write_bytes(page, text.encode())
    return notes


def _images(path: Path, size: int) -> "dict[str, np.ndarray]":
    """Returns images of the first stored episode by camera, from its start to its end."""
    from starjax.data import episode_images, store

    records = [store.verify(path, key, arrays=False) for key in store.keys(path)]
    record = next(record for record in records if record["files"])
    last = record["length"] - 1
    steps = [round(last * moment / (_MOMENTS - 1)) for moment in range(_MOMENTS)]
    return episode_images.of_episode(path, record["key"], steps, size)
