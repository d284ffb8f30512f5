"""What all the rest stands on: safe files, progress, signals, XLA settings, a hash. No jax."""

from starjax.runtime.xla import prepare_xla

__all__ = ["prepare_xla"]
