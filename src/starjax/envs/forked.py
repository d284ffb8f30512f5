"""Processes forked after jax has started: its threads are missing, and programs never end."""

import os

from starjax.core.errors import UsageError
from starjax.runtime import xla

_was_started = False


def _after_fork() -> None:
    global _was_started
    _was_started = xla.has_started()


if hasattr(os, "register_at_fork"):  # not on Windows, which cannot fork
    os.register_at_fork(after_in_child=_after_fork)


def refuse() -> None:
    """Raises UsageError in a process that was forked after jax had started."""
    if _was_started:
        raise UsageError(
            "vectorization_mode",
            "processes that are spawned",
            "one forked after jax had started, which would never answer",
            "vector_kwargs={'context': 'spawn'}, or vectorization_mode='vector_entry_point'",
        )
