"""`starjax list`: lists the names that flags take."""

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from starjax.cli import options, presets
from starjax.core import errors, extensions, methods
from starjax.core.config import RunConfig
from starjax.core.learners import ENCODERS, LEARNERS, Learner
from starjax.policies import packaged
from starjax.policies.external import POLICIES
from starjax.runtime import files
from starjax.sim import registries
from starjax.sim.arms.base import Arm
from starjax.sim.registries import Registry
from starjax.sim.tools.base import Tool

if TYPE_CHECKING:  # it imports jax, which `--help` does without
    from starjax.evaluation.disturbances.base import Disturbance
    from starjax.policies.models.encoders import Trunk
    from starjax.rcm import ActionSpace
    from starjax.sim.task import Task

DESCRIPTION = """Lists tasks, arms, tools, methods, learners, presets and policies by name.

KIND is one of them; the arms then have their mounts.

Examples:
  starjax list
  starjax list arms"""

Row = tuple[str, str]  # name, description


@dataclasses.dataclass(frozen=True)
class ListArgs:
    """Flags of the command."""

    # one table, such as arms or action-spaces; default: all
    kind: Annotated[
        str, tyro.conf.Positional, tyro.conf.arg(metavar="[KIND]", help_behavior_hint="")
    ] = ""


def main(argv: Sequence[str]) -> int:
    """Prints the tables."""
    args = options.parse("list", ListArgs, argv, DESCRIPTION)
    from starjax.evaluation.disturbances import DISTURBANCES
    from starjax.rcm import ACTION_SPACES

    tables = {
        "tasks (--task, --camera, --demos.expert)": described(registries.tasks, _task),
        "arms (--arm)": described(registries.arms, _arm if args.kind else _arm_briefly),
        "tools (--tool)": described(registries.tools, _tool),
        "methods (--method)": _methods(),
        "action spaces (of methods, Gymnasium)": described(ACTION_SPACES.registry, _space),
        "learners (--policy.learner)": described(LEARNERS, _learner),
        **(formats() if (formats := extensions.hook("list")) else {}),
        "disturbances (stress, --demos.randomise)": described(DISTURBANCES, _disturbance),
        "encoders (--policy.encoder)": described(ENCODERS, _encoder),
        "presets (--preset)": _presets(),
        "policies (--policy, --policy.encoder-weights)": _policies(),
    }
    kinds = {title.partition(" (")[0].replace(" ", "-"): title for title in tables}
    if args.kind:
        errors.choice("KIND", args.kind, kinds)
    for title in [kinds[args.kind]] if args.kind else tables:
        print(title, flush=True)  # before the tasks, which import jax
        rows = list(tables[title])
        width = max(len(name) for name, _ in rows) if rows else 0
        print("\n".join(f"  {name:{width}}  {text}" for name, text in rows) + "\n")
    return 0


def described(registry: Registry, describe: Callable[[Any], str]) -> Iterator[Row]:
    for name in registry.names():
        try:
            yield name, describe(registry.get(name))
        except errors.UsageError as error:  # from a package that cannot be used
            yield name, f"cannot be used: {error.got}"
        except Exception as error:
            yield name, f"cannot be used: {registry.path(name)}: {type(error).__name__}: {error}"


def _task(task: "Task") -> str:
    arms = f"{task.arms} arm{'s' if task.arms > 1 else ''}"
    sees, shows = ", ".join(task.cameras), ", ".join(task.experts)
    return f"{task.text.title}: {arms}; cameras {sees}; experts {shows}"


def _arm_briefly(arm: Arm) -> str:
    return f"{len(arm.joints)} joints; {len(arm.mounts)} mounts, see starjax list arms"


def _arm(arm: Arm) -> str:
    places = [f"{tool} over the {place}" for tool, place in arm.mounts]
    return f"{len(arm.joints)} joints; mounted with {', '.join(places) or 'nothing yet'}"


def _tool(tool: Tool) -> str:
    if tool.wrist is not None:
        pitch, yaw = (math.degrees(limit) for limit in (tool.wrist.pitch, tool.wrist.yaw))
        jaws = f"wrist of {pitch:.0f} and {yaw:.0f} degrees"
    else:
        jaws = f"jaws that open {2e3 * (tool.open - tool.closed):.1f} mm" if tool.jaw else "no jaws"
    return f"{jaws}; shaft of {2e3 * tool.shaft_radius:g} mm"


def _methods() -> Iterator[Row]:
    yield from described(methods.METHODS.registry, _method)
    yield "all", f"the {len(methods.TABLE_II)} of the paper's Table II"


def _method(row: methods.Method) -> str:
    from starjax.rcm import ACTION_SPACES

    space = ACTION_SPACES.registry.get(row.action_space)
    rolls = f"; a network for {' and '.join(space.turns)}" * row.hierarchical
    rolls += "; moves a wrist" * (space.for_wrist is not None)
    condition = "; conditioned on the trocar" * row.sees_trocar + "; projected" * row.projects
    return f"{row.label}: actions {row.action_space}{rolls}{condition}"


def _space(space: "ActionSpace") -> str:
    return f"{space.dim} numbers: {', '.join(space.slices)}"


def _encoder(trunk: "Trunk") -> str:
    return f"{trunk.width} channels, cells of {trunk.cell} pixels"


def _learner(learner: Learner) -> str:
    return ", ".join(field.name for field in dataclasses.fields(learner.settings))


def _disturbance(disturbance: "Disturbance") -> str:
    return disturbance.description


def _presets() -> Iterator[Row]:
    yield "auto", "gpu where jax runs on one, else cpu"
    yield from described(presets.PRESETS.registry, _preset)


def _preset(preset: RunConfig) -> str:
    policy, train, demos = preset.policy, preset.train, preset.demos
    seen = f"images of {policy.image_size} px" if policy.observation == "image" else "the state"
    count = f"{demos.per_trocar * demos.seen_trocars} demonstrations"
    return f"{count} of {seen}, {train.steps} steps of {train.batch_size}"


def _policies() -> Iterator[Row]:
    for name in packaged.names():
        about = files.read_json(packaged.locate(name).with_suffix(".json"))
        label = methods.METHODS[about["method"]].label
        scores = ", ".join(
            f"{part} {about[part]['successes']}/{about[part]['trials']}"
            for part in ("seen", "unseen")
        )
        task = about["scene"]["task"]
        yield name, f"{label} for {task}; successes at trocars: {scores}"
    yield from described(POLICIES, lambda policy: f"{policy.description}, for {policy.task}")
