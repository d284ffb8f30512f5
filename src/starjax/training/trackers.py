"""Copies of the training log for trackers of experiments: TensorBoard and Weights & Biases.

A tracker follows the log, opens with the first line and imports its package only then.
"""

import contextlib
import importlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from starjax.training import log

PROJECT = "starjax"  # for Weights & Biases


# (step, name -> number) adds values; the other function writes pending ones.
OpenTracker = tuple[Callable[[int, dict[str, float]], None], Callable[[], None]]


def tensorboard(folder: Path, settings: Mapping[str, Any], step: int) -> OpenTracker:
    """Opens an event file in `folder/tensorboard`, without older values from `step` on."""
    package = importlib.import_module("tensorboardX")
    writer = package.SummaryWriter(str(folder / "tensorboard"), purge_step=step)

    def add(step: int, values: dict[str, float]) -> None:
        for name, value in values.items():
            writer.add_scalar(name, value, step)
        writer.flush()

    return add, writer.close


def wandb(folder: Path, settings: Mapping[str, Any], step: int) -> OpenTracker:
    """Opens a run of Weights & Biases, or the interrupted one of this folder."""
    name = "/".join(folder.absolute().parts[-2:])
    run = importlib.import_module("wandb").init(
        project=PROJECT, name=name, dir=str(folder), config=dict(settings), resume="auto"
    )
    return lambda step, values: run.log(values, step=step), run.finish


# Name, which is also the extra's -> opens it: (folder, settings, first step).
TRACKERS: dict[str, Callable[[Path, Mapping[str, Any], int], OpenTracker]] = {
    "tensorboard": tensorboard,
    "wandb": wandb,
}


@contextlib.contextmanager
def following(name: str, folder: Path, settings: Mapping[str, Any]) -> Iterator[None]:
    """Sends all lines that the training log gets meanwhile to a tracker.

    Args:
      name: key of `TRACKERS`; with any other, nothing is tracked.
      folder: directory of the method's run.
      settings: JSON values that the tracker shows with the run.
    """
    if name not in TRACKERS:
        yield
        return
    with contextlib.ExitStack() as stack:
        writers: list[OpenTracker] = []

        def follow(step: int, kind: str, values: Mapping[str, Any]) -> None:
            if not writers:
                writers.append(TRACKERS[name](folder, settings, step))
                stack.callback(writers[0][1])
            writers[0][0](step, {f"{kind}/{key}": value for key, value in values.items()})

        stack.enter_context(log.followed_by(follow))
        yield
