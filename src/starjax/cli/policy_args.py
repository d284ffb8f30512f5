"""Flags that name a trained policy, and the file and the results' directory that they mean."""

import dataclasses
import json
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

from starjax.cli import checks, folders, options, scenes
from starjax.core import config as config_lib
from starjax.core import errors, extras
from starjax.policies import packaged
from starjax.policies.external import POLICIES
from starjax.runtime import files

if TYPE_CHECKING:  # they import jax
    from starjax.policies.in_env import PolicyInEnv
    from starjax.policies.policy_file import Trained

SCHEMES = ("ws://", "wss://")
SAMPLING = "--sampling"  # flag of evaluate
_IN_PROCESS = "policy://"  # address of a policy of another package


@dataclasses.dataclass(frozen=True)
class PolicyArgs:
    """Flags of commands that run a trained policy."""

    run: options.RunOrNone = ""  # directory of a method, such as runs/cpu/stardiff
    # policy.safetensors, name of a packaged policy or of another package's, or ws://HOST:PORT of a
    # server, instead of RUN
    policy: str = ""
    arm: tuple[str, ...] = ()  # robots to score with; default: those of the training


class PolicyPath(NamedTuple):
    """Files of the policy that a command line names.

    Attributes:
      file: its weights.
      run: directory of its method, None if the file itself was named.
      arms: robots instead of those of the training.
      address: of a server instead of a file, else empty.
      sampling: option of the policy's learner -> value instead of that of the training.
      execute: commands of a plan to execute instead of those of the training; 0: the same.
    """

    file: Path
    run: Path | None
    arms: tuple[str, ...] = ()
    address: str = ""
    sampling: Mapping[str, Any] = MappingProxyType({})
    execute: int = 0

    def folder(self, command: str, parts: Sequence[str], out: str = options.AUTO) -> Path:
        """Returns the directory of a command's results.

        Args:
          command: first word of the directory's name.
          parts: further words, which keep different evaluations apart.
          out: value of --out.

        Raises:
          errors.UsageError: `out` is no directory that can be written.
        """
        if self.run:
            default = self.run / "-".join([command, *self.arms, *parts])
        else:
            name = _address_label(self.address) if self.address else label(self.file)
            default = Path("runs") / command / "-".join([name, *self.arms, *parts])
        folder = default if out == options.AUTO else Path(out)
        checks.expect_folder("--out", out and folder)
        return folder


def resolve(args: PolicyArgs) -> PolicyPath:
    """Finds the file of the policy that RUN or --policy names.

    Raises:
      errors.UsageError: both or neither are set, or there is no such file.
    """
    if bool(args.run) == bool(args.policy):
        got = "both" if args.run else "none"
        raise errors.UsageError("RUN or --policy", "one of the two", got)
    if args.policy.startswith(SCHEMES):
        extras.require("--policy", "serve")
        return PolicyPath(Path(), None, args.arm, args.policy)
    if args.policy in POLICIES.names():
        extras.require("--policy", "serve")
        return PolicyPath(Path(), None, args.arm, f"{_IN_PROCESS}{args.policy}")
    if args.policy:
        return PolicyPath(packaged.find("--policy", args.policy), None, args.arm)
    folder = folders.existing(args.run)
    folders.read_config(folder)
    return PolicyPath(folders.weights(folder.parent, folder.name), folder, args.arm)


def sampling(texts: Sequence[str]) -> dict[str, Any]:
    """Parses options of the form `NAME=NUMBER`.

    Raises:
      errors.UsageError: a text has another form, or a name is repeated.
    """
    options: dict[str, Any] = {}
    for text in texts:
        name, _, number = text.partition("=")
        try:
            value = json.loads(number)
        except ValueError:
            value = None
        if isinstance(value, bool) or not isinstance(value, int | float) or name in options:
            raise errors.UsageError(SAMPLING, "NAME=NUMBER, each name once", text)
        options[name] = value
    return options


def _address_label(address: str) -> str:
    """Returns a name for a server's address: its words."""
    return "-".join(re.findall(r"[\w.]+", address.partition("://")[2]))


def label(file: Path) -> str:
    """Returns a name for a file of weights: its stem or directory plus eight digits of its hash."""
    if packaged.is_packaged(file):
        return file.stem
    name = file.stem if file.stem != "policy" else file.resolve().parent.name
    return f"{name}-{files.sha256(file)[:8]}"


def load(path: PolicyPath) -> tuple["PolicyInEnv", config_lib.RunConfig]:
    """Loads a policy in its scene.

    Returns:
      The policy, and the settings of the run that it comes from as far as known.
    """
    from starjax.cli import policy_evaluation  # it imports jax
    from starjax.policies import in_env
    from starjax.policies import sampling as samples

    if path.address.startswith(_IN_PROCESS):
        from starjax.deploy import external

        who = external.connect(path.address.removeprefix(_IN_PROCESS), path.arms)
        return who, run_settings(who.trained)
    if path.address:
        from starjax.deploy import served

        who = served.connect(path.address, os.environ.get(checks.API_KEY, ""), path.arms)
        return who, run_settings(who.trained)
    read = in_env.read if path.run is None else policy_evaluation.read
    trained = samples.applied(SAMPLING, read(path.file), path.sampling)
    if path.execute:
        most, argument = trained.policy.horizon, "--execute"
        checks.expect(path.execute <= most, argument, f"at most {most}, a plan", path.execute)
        policy = dataclasses.replace(trained.policy, execute=path.execute)
        # A monitor is calibrated for the training's plans.
        trained = trained._replace(policy=policy, monitor=None)
    method = path.run.name if path.run else ""
    who = in_env.place_in_own_scene(path.file, trained, method=method, arms=path.arms)
    if path.run is None:
        return who, run_settings(who.trained)
    config = folders.read_config(path.run)
    trained = who.trained  # another method may have trained these weights, with other settings
    demos = trained.demos or config.demos
    return who, dataclasses.replace(config, policy=trained.policy, train=trained.train, demos=demos)


def run_settings(trained: "Trained") -> config_lib.RunConfig:
    """Returns the settings of a policy's run, as far as its file has them."""
    settings = config_lib.RunConfig(
        method=trained.method,
        preset=trained.preset or "auto",
        policy=trained.policy,
        train=trained.train,
        demos=trained.demos or config_lib.DemosConfig(),
        scene=scenes.settings(trained.scene),
    )
    unknown: dict[str, Any] = {"seed": None}  # no policy file has it
    return dataclasses.replace(settings, **unknown)
