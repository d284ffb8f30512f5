"""What every command needs from the machine: safe files, progress, XLA settings. No jax inside."""

from starjax.runtime.xla import prepare_xla

__all__ = ["prepare_xla"]
