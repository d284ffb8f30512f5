"""Names that moved: the import of an old one fails with the new one."""

import sys

# Old package or module -> new one, each without "starjax.".
NAMES = {
    "data.formats": "addons.formats",
    "commands.calibrate": "addons.finetune.commands.calibrate",
    "deploy.crtk": "addons.robots.crtk",
    "deploy.psm": "addons.robots.psm",
    "envs.exported": "addons.formats.exported",
    "envs.on_device": "addons.playground.on_device",
    "envs.playground": "addons.playground.environment",
    "envs.playground_registry": "addons.playground.registry",
    "finetune": "addons.finetune",
    "rollouts": "sim.rollouts",
    "report.playback_3d": "addons.viewer.playback_3d",
    "sim.mount_search": "addons.robots.mount_search",
    "sim.six_blocks": "addons.six_blocks.environment",
    "sim.tasks.needle_drive": "addons.suture.needle_drive",
    "sim.tasks.needle_regrasp": "addons.suture.needle_regrasp",
    "sim.tasks.suture_throw": "addons.suture.suture_throw",
    "sim.thread": "addons.suture.thread",
    "sim.tissue": "addons.suture.tissue",
    "viewer": "addons.viewer",
    "api": "cli.api",
    "commands": "cli",
    "config": "core.config",
    "config_json": "core.config_json",
    "doctor": "cli.doctor",
    "errors": "core.errors",
    "extensions": "core.extensions",
    "extras": "core.extras",
    "learners": "core.learners",
    "limits": "core.limits",
    "methods": "core.methods",
    "models": "policies.models",
    "monitor": "policies.monitor",
    "registry": "core.registry",
    "sim.tasks.base": "sim.task",
    "sim.tasks.rescue": "sim.rescuer",
    "types": "core.types",
    "sim.tasks": "tasks",
}


class Finder:
    """Finder of modules that finds none, for `sys.meta_path`.

    The first in line: an old folder in which Python left its caches would be found as a package.
    """

    @staticmethod
    def find_spec(name: str, *args: object) -> None:
        """Raises ModuleNotFoundError for a name that moved."""
        package, _, inside = name.partition(".")
        if package != "starjax":
            return None
        for old, new in NAMES.items():
            if f"{inside}.".startswith(f"{old}."):
                # Without `name=`, which would let `from starjax.sim import thread` drop the text.
                raise ModuleNotFoundError(f"{name} is now starjax.{new}{inside[len(old) :]}")
        return None


def install() -> None:
    """Registers the finder."""
    sys.meta_path.insert(0, Finder)
