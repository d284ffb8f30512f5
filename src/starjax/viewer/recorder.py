"""Episodes that a person demonstrates, kept as an ordinary dataset that is complete after each."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from starjax.data import schema, store
from starjax.rollouts import episodes
from starjax.rollouts import trocars as configurations
from starjax.runtime import files
from starjax.viewer.steering import Moment

OPERATOR = "operator"  # stands in dataset.json where a scripted expert has its name


class Recorder:
    """Records one episode after another into the folder `root`.

    Attributes:
      kept: successful episodes that the dataset has.
    """

    def __init__(self, root: Path, env: Any, seed: int):
        self._root, self._seed = root, seed
        self._trocars = configurations.listed(env.task.trocars, len(env.p_world_ref))
        steps = round(env.task.time_limit_s * env.control_hz)
        settings = schema.DemoSettings(per_trocar=0, seed=seed, max_steps=steps, keep_failures=True)
        description = schema.describe(env, self._trocars, settings)
        store.create(root, {**description, "expert": OPERATOR})
        store.clean(root)
        self._records = {key: store.verify(root, key, arrays=False) for key in store.keys(root)}
        self._moments: list[Moment] = []

    @property
    def kept(self) -> int:
        return sum(record["success"] for record in self._records.values())

    @property
    def length(self) -> int:
        """Control steps of the episode so far."""
        return len(self._moments)

    def next_trial(self, configuration: int) -> int:
        """The number of the next new trial through a configuration of trocars."""
        taken = [r["trial"] for r in self._records.values() if r["trocar"] == configuration]
        return max(taken, default=-1) + 1

    def add(self, moment: Moment) -> None:
        """Records a control step."""
        self._moments.append(moment)

    def discard(self) -> None:
        """Forgets the episode."""
        self._moments.clear()

    def save(self, configuration: int, trial: int) -> Path:
        """Writes the episode, on disk and whole when this returns; its folder.

        Raises:
          files.StorageError: the disk is full or cannot be written; the episode stays in memory.
        """
        fields = {
            name: np.stack([moment.fields[name][0] for moment in self._moments])
            for name in self._moments[0].fields
        }
        images = {n: [x] for n, x in fields.items() if n.startswith(episodes.IMAGE)}
        others = {n: x[None] for n, x in fields.items() if n not in images}
        status = {**self._moments[-1].status, "length": np.array([self.length])}
        episode = episodes.assemble(
            0, (configuration, trial), self._trocars, self._seed, status, [others], images
        )
        key = store.key(configuration, trial, self._seed)
        self._records[key] = store.commit(self._root, key, episode.outcome, episode.arrays)
        store.seal(self._root, self._records)
        self.discard()
        return self._root / "episodes" / key


@contextlib.contextmanager
def opened(root: Path, env: Any, seed: int) -> Iterator[Recorder]:
    """Yields a recorder into a folder that is this process's until the end.

    Raises:
      files.StorageError: another process holds it, or it has another dataset.
    """
    with files.lock(root):
        yield Recorder(root, env, seed)
