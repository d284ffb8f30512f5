"""starjax: surgical trocar-adaptive diffusion policy, in JAX and MJX.

These names are the package's face; modules that the reference lists are public too, and all others
are internal and may change. Each is imported on first use, so that `import starjax`, `--help` and
errors of a command line do without jax.

    make_env, load_policy     a task's environment; a trained policy in one
    train, evaluate           a policy from an expert's demonstrations; its success at trocars
    TASKS, ARMS, METHODS, LEARNERS, PRESETS    parts by name
    rcm, deploy               maps about the remote centre of motion; a policy in a robot's loop
"""

import importlib
from typing import TYPE_CHECKING, Any

from starjax.core import moved

if TYPE_CHECKING:  # for editors
    from starjax import deploy, rcm
    from starjax.cli.api import evaluate, load_policy, train
    from starjax.core.registry import Rows
    from starjax.sim.env import make as make_env

    ARMS: Rows
    LEARNERS: Rows
    METHODS: Rows
    PRESETS: Rows
    TASKS: Rows

__version__ = "0.2.0"
__all__ = (
    "ARMS", "LEARNERS", "METHODS", "PRESETS", "TASKS",
    "deploy", "evaluate", "load_policy", "make_env", "rcm", "train",
)  # fmt: skip
# Name -> `module:object`, or a module.
_PLACES = {
    "ARMS": "starjax.sim.registries:arms",
    "LEARNERS": "starjax.core.learners:LEARNERS",
    "METHODS": "starjax.core.methods:METHODS",
    "PRESETS": "starjax.cli.presets:PRESETS",
    "TASKS": "starjax.sim.registries:tasks",
    "deploy": "starjax.deploy",
    "evaluate": "starjax.cli.api:evaluate",
    "load_policy": "starjax.cli.api:load_policy",
    "make_env": "starjax.sim.env:make",
    "rcm": "starjax.rcm",
    "train": "starjax.cli.api:train",
}
_COMPILED = ("evaluate", "load_policy", "make_env", "train")
moved.install()


def __getattr__(name: str) -> Any:
    """Imports a name of the face."""
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from starjax import runtime
    from starjax.core import registry

    if name in _COMPILED:
        runtime.prepare_xla()  # jax reads these settings when it starts
    module, _, attribute = _PLACES[name].partition(":")
    found = importlib.import_module(module)
    found = getattr(found, attribute) if attribute else found
    found = registry.Rows(found) if isinstance(found, registry.Registry) else found
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return [*globals(), *__all__]
