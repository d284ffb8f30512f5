"""What the other processes of a run do: their share of each training and of its checkpoints."""

import functools
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from starjax import config as config_lib
from starjax import methods
from starjax.runtime import files
from starjax.runtime.signals import stop_signals


def follow(
    config: config_lib.RunConfig,
    trained: Sequence[str],
    root: Path,
    env: Any,
) -> None:
    """Trains along with the first process, then waits until that one has done the rest.

    Args:
      config: settings of the run.
      trained: names of the methods that are trained, in order; none if the run does not train.
      root: folder of the demonstrations, which the first process collects.
      env: `sim.env.Env` of the run's scene.
    """
    from starjax.data import load
    from starjax.runtime import processes
    from starjax.training import loop

    dataset = functools.cache(lambda: load.load(root).dataset)

    processes.agree(0)  # from here on the first one holds the folder
    for name in trained:
        (done,) = processes.agree(0)
        if done:
            continue
        _await(root)
        processes.agree(0)  # the first one has checked them, and collected again what was damaged
        demos = dataset()
        with stop_signals() as should_stop:
            loop.run(
                methods.METHODS[name],
                config.policy,
                config.train,
                demos,
                env.task,
                Path(config.out) / name,
                config.seed,
                cameras=env.names.cameras,
                should_stop=should_stop,
                description=f"Training {name}",
            )
    # A process that leaves early would end the others.
    files.wait_until_free(Path(config.out))


def _await(root: Path) -> None:
    """Waits for the demonstrations, which may take longer than devices wait for each other."""
    from starjax.data import store

    while not store.is_sealed(root):
        time.sleep(1.0)
