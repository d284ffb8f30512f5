"""A command at work: its settings read once, jax started, its processes joined.

Imports jax and numpy only when a session starts: `--help` and mistakes come before.
"""

import contextlib
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

from starjax.cli import options
from starjax.core import config as config_lib
from starjax.runtime import gpu, jax_start, xla

SettingsT = TypeVar("SettingsT")

# Modules that take seconds to import, in the meantime of a GPU's start.
RUN_MODULES = ("starjax.cli.pipeline",)
POLICY_MODULES = ("starjax.cli.policy_evaluation",)


class Session(NamedTuple):
    """A started command.

    Attributes:
      command: command line, for results.
      folder: directory of the results.
    """

    command: str
    folder: Path

    @contextlib.contextmanager
    def shared(self, settings: Mapping[str, Any] = MappingProxyType({})) -> Iterator[Any]:
        """Holds the directory for this run and silences all processes but the first.

        Args:
          settings: of the command as JSON values, which some derive from the device.

        Yields:
          The `sharing.Share` of this process.

        Raises:
          errors.UsageError: the processes of the run have different commands, settings or folders.
        """
        from starjax.cli import messages
        from starjax.runtime import processes
        from starjax.sim.rollouts import sharing

        processes.expect_same(
            "command, settings and folder",
            f"{self.command}, into {self.folder.absolute()}",
            dict(settings),
        )
        with sharing.shared(self.folder) as share, messages.first_process_only(share.is_first):
            yield share

    def write(self, name: str, content: dict[str, Any]) -> Path:
        """Writes a JSON file with the command, code, versions and machine that made it.

        The `scene` of the content names the packages whose parts took part.
        """
        from starjax.core import sources
        from starjax.runtime import files, jax_settings, provenance
        from starjax.sim import names, registries

        scene = content.get("scene")
        parts = registries.parts(names.SceneNames(**scene)) if scene else []
        made_by = {
            "command": self.command,
            **provenance.code()._asdict(),
            "versions": {**xla.versions(), **sources.packages(parts)},
            "hardware": xla.hardware(),
            **jax_settings.record(),
        }
        files.write_json(self.folder / name, {**content, **made_by})
        return self.folder / name


def start_jax(*modules: str) -> None:
    """Starts jax in all processes of a run; imports `modules` while the devices start."""
    jax_start.announce_start()
    xla.prepare_xla()
    from starjax.runtime import processes

    processes.join()
    jax_start.require_devices(*modules)


def start_run(config: config_lib.RunConfig) -> None:
    """Prints the first line of a run, then starts jax."""
    named = f"method {config.method}, preset {config.preset}, seed {config.seed}"
    jax_start.announce(f"{named}, folder {config.out}", sys.stdout)
    start_jax(*RUN_MODULES)


def start(name: str, argv: Sequence[str], folder: Path, free_bytes: int = 0) -> Session:
    """Starts a command that runs policies.

    Args:
      name: subcommand.
      argv: words after it.
      folder: directory of its results.
      free_bytes: disk space that it needs there.

    Raises:
      StorageError: the directory cannot be written.
    """
    start_jax(*POLICY_MODULES)
    from starjax.runtime import files

    files.require_writable(folder, free_bytes)
    return Session(options.typed(name, argv), folder)


def for_device(parse: Callable[[bool], SettingsT], *modules: str) -> SettingsT:
    """Returns settings whose defaults depend on the device; starts jax.

    Args:
      parse: takes True for a GPU. It runs once before jax starts, for the device that the system
        shows, and again only if jax runs on another.
      modules: see `start_jax`.
    """
    guess = gpu.is_likely()
    settings = parse(guess)
    start_jax(*modules)
    return settings if gpu.is_used() == guess else parse(not guess)
