"""How fast this machine's processor is, beside the one that runs were timed on."""

import time

import numpy as np

from starjax.runtime import xla

CORES = 2  # of the machine that `commands.estimate` has its figures from
_SECONDS = 0.286e-3  # that `_work` takes on one of them, an AMD EPYC's
_TRIES = 50


def pace() -> float:
    """Seconds that this machine takes for what the timed one did in a second.

    The quickest of many tries, some milliseconds in all: what else runs meanwhile does not count.
    With more cores a run is quicker, by how much nobody has timed: they count as two.
    """
    random = np.random.default_rng(0).random(1 << 14).astype(np.float32)
    ramp = np.linspace(-3.0, 3.0, 1 << 15, dtype=np.float32)
    taken = []
    for _ in range(_TRIES):
        start = time.perf_counter()
        _work(random, ramp)
        taken.append(time.perf_counter() - start)
    return min(taken) / _SECONDS * max(CORES / xla.cores(), 1.0)


def _work(random: np.ndarray, ramp: np.ndarray) -> None:
    np.sort(random)
    (ramp * ramp + ramp).sum()
    np.tanh(ramp)
