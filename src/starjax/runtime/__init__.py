"""Ground of all the rest: safe files, progress, signals, settings of jax and XLA, a hash.

Only `jax_settings` imports jax.
"""

from starjax.runtime.xla import prepare_xla

__all__ = ["prepare_xla"]
