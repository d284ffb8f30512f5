"""The start of jax in a command. Importing it imports no jax."""

import contextlib
import functools
import importlib
import os
import sys
from typing import TextIO

import starjax
from starjax.core import errors
from starjax.runtime import background, notice

# Number of this process in a run of several, as jax and srun name it.
_PROCESS_NUMBERS = ("JAX_PROCESS_ID", "SLURM_PROCID")


def announce(text: str, stream: TextIO | None = None) -> None:
    """Prints the first line of a command, before the seconds that jax takes to start.

    Args:
      text: next action of the command.
      stream: output; by default the standard error stream.
    """
    if all(os.environ.get(name, "") in ("", "0") for name in _PROCESS_NUMBERS):
        print(f"starjax {starjax.__version__}: {text}", file=stream or sys.stderr, flush=True)


@functools.cache
def announce_start() -> None:
    """Announces the start of jax, once."""
    announce("starting jax")


def require_devices(*modules: str) -> None:
    """Starts jax for a command and imports `modules` meanwhile, because a GPU takes two seconds.

    Settings of jax that would change results or end programs get their usual values; a line names
    those that the user's environment sets to others.

    Raises:
      errors.UsageError: jax cannot use the platform of JAX_PLATFORMS.
    """
    announce_start()
    import jax

    from starjax.runtime import jax_settings

    typed = [name.upper() for name in jax_settings.fix() if name.upper() in os.environ]
    if typed:
        why = "results of all users have the same"
        print(f"starjax: {', '.join(typed)} of the environment: not used, {why}", file=sys.stderr)

    def start() -> None:
        for device in jax.local_devices():
            # A GPU's memory is taken with the first array, the longer part of its start.
            with contextlib.suppress(RuntimeError):  # a full GPU raises at its first real use
                jax.device_put(0, device)

    notice.once(lambda: announce("compiling; later starts find the programs in the cache"))
    started = background.run_in_background(start)
    for module in modules:
        importlib.import_module(module)
    try:
        started()
    except (AssertionError, RuntimeError) as error:  # the first for a platform without its plugin
        requested = os.environ.get("JAX_PLATFORMS", "")
        reason = str(error).splitlines()[0] if str(error) else "its plugin is not installed"
        raise errors.UsageError(
            "JAX_PLATFORMS",
            "a platform that jax can use here",
            f"{requested!r}: {reason}",
            "starjax doctor says more",
        ) from error
