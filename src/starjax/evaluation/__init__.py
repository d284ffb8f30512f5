"""Closed-loop evaluation of a trained policy: rollouts, statistics, sweeps, results as tables."""

from typing import Any


def __getattr__(name: str) -> Any:
    """Imports `results` on first use, because it needs jax and the disturbances do not."""
    if name == "results":
        from starjax.evaluation import frame

        return frame.results
    raise AttributeError(name)
